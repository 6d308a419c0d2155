"""Base logs of `tests.studies.entrance_other_cases`: parts of real drives, and simulated robots with contacts of their own."""

from __future__ import annotations

import functools
import json
import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader

from localization.evaluation.metrics import align
from localization.simulation.simulator import simulate, write_simulation
from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.robot_file import load_robot
from tests.helpers import bags
from tests.helpers.bags import START, Record, S
from tests.helpers.entrance_drives import with_times
from tests.studies.entrance_commands import Case, Edit, contradictions, judge_scores, replayed, run_command, warnings_in
from tests.studies.entrances import Found, choose_outcome

DATA, ROBOTS = Path("tests/data"), Path("motion_models/robots")


@dataclass(frozen=True, eq=False)
class BaseLog:
    """A healthy log; its stamps begin at `START`."""

    name: str
    robot: str
    """Text of the robot file."""
    load: Callable[[], tuple[list[Record], Trajectory | None]]
    """Records by time, and the true poses; None: those of the healthy replay stand for them."""
    tolerance_m: float = 0.05
    """How much larger an error may be than that of the log with nothing wrong: 0.5 % of the way, at least 5 cm."""


def records_in(path: Path, begin_s: float, seconds: float) -> list[Record]:
    """Records of a part of a log, by time of recording; transforms of any time are at its beginning."""
    with AnyReader([path], default_typestore=bags.STORE) as reader:
        first = reader.start_time + round(begin_s * S)
        found: list[Record] = []
        for connection, log, raw in reader.messages():
            is_static = connection.topic == "/tf_static"
            if not is_static and not first <= log < first + seconds * S:
                continue
            if "String" in connection.msgtype:
                continue
            message = _writable(reader.deserialize(raw, connection.msgtype))
            moved = with_times(message, lambda ns, s=is_static: START if s else ns - first + START)
            found.append((connection.topic, moved, START if is_static else log - first + START))
    return found


def _writable(message: Any) -> Any:
    for name, value in vars(message).items():
        if isinstance(value, np.ndarray):
            setattr(message, name, value.copy())
    return message


def truth_in(records: list[Record], topic: str) -> tuple[list[Record], Trajectory]:
    """Records without ``topic``, and its poses."""
    poses, stamps = [], []
    for t, m, _ in records:
        if t == topic:
            p = m.pose if hasattr(m.pose, "position") else m.pose.pose
            poses.append([p.position.x, p.position.y, 2.0 * math.atan2(p.orientation.z, p.orientation.w)])
            stamps.append(m.header.stamp.sec * S + m.header.stamp.nanosec)
    return [r for r in records if r[0] != topic], Trajectory(np.array(stamps), np.array(poses))


def real_building(folder: str, log: str, begin_s: float, seconds: float) -> Callable[[], tuple[list[Record], Trajectory | None]]:
    """A part of a log with a reference on /reference/pose."""

    def load() -> tuple[list[Record], Trajectory | None]:
        return truth_in(records_in(DATA / folder / log, begin_s, seconds), "/reference/pose")

    return load


def real_log(path: str, begin_s: float, seconds: float) -> Callable[[], tuple[list[Record], Trajectory | None]]:
    """A part of a log without a reference."""
    return lambda: (records_in(DATA / path, begin_s, seconds), None)


def boreal(terrain: str, run: str, begin_s: float, seconds: float) -> Callable[[], tuple[list[Record], Trajectory | None]]:
    """Wheels (6.5 Hz) and IMU (100 Hz) of a Husky off road."""

    def load() -> tuple[list[Record], Trajectory | None]:
        folder = DATA / "borealtc-husky" / terrain
        wheels = np.loadtxt(folder / f"pro_{run}.csv", delimiter=",", skiprows=1)
        imu = np.loadtxt(folder / f"imu_{run}.csv", delimiter=",", skiprows=1)
        mount = ("base_link", "imu_link", (0.0, 0.0, 0.1), bags.quaternion())
        records: list[Record] = [("/tf_static", bags.tf(START, [mount]), START)]
        angles = np.cumsum(np.diff(wheels[:, 0], prepend=wheels[0, 0])[:, None] * wheels[:, 3:5], axis=0) / 0.1651
        for row, (left, right) in zip(wheels, angles, strict=True):
            if begin_s <= row[0] < begin_s + seconds:
                stamp = START + round((row[0] - begin_s) * S)
                rates = row[[3, 3, 4, 4]] / 0.1651
                records.append(("/joint_states", bags.joint_state(stamp, FOUR, [left, left, right, right], rates), stamp + S // 250))
        for row in imu:
            if begin_s <= row[0] < begin_s + seconds:
                stamp = START + round((row[0] - begin_s) * S)
                records.append(("/imu/data", bags.imu(stamp, row[1:4], row[4:7], "imu_link"), stamp + S // 500))
        return sorted(records, key=lambda record: record[2]), None

    return load


FOUR = ("front_left_wheel", "rear_left_wheel", "front_right_wheel", "rear_right_wheel")


def simulated(
    robot: str, experiment: str, seed: int, begin_s: float, seconds: float
) -> Callable[[], tuple[list[Record], Trajectory | None]]:
    """A part of `skidloc simulate`."""

    def load() -> tuple[list[Record], Trajectory | None]:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "log.mcap"
            write_simulation(path, simulate(experiment, load_robot(robot), seed, {}), lambda log_ns: None)
            return truth_in(records_in(path, begin_s, seconds), "/ground_truth/odom")

    return load


def _file(path: Path, *left_out: str) -> str:
    """Text of a robot file without some tables."""
    parts = path.read_text().split("\n[")
    return "\n[".join(part for part in parts if not part.startswith(tuple(f"{name}]" for name in left_out)))


CORRIDOR = BaseLog("fr079, 500 to 600 s", _file(DATA / "fr079/fr079.toml", "topics"), real_building("fr079", "fr079.mcap", 500.0, 100.0))
OFFICE = BaseLog(
    "MIT-CSAIL, 60 to 150 s", _file(DATA / "mit-csail/csail.toml", "topics"), real_building("mit-csail", "csail.mcap", 60.0, 90.0)
)
HALL = BaseLog("ACES, 100 to 190 s", (ROBOTS / "aces.toml").read_text(), real_log("aces/aces.mcap", 100.0, 90.0))
MEADOW = BaseLog(
    "Husky outdoors, 60 to 180 s", _file(ROBOTS / "husky_a200.toml"), real_log("husky-outdoor-gps/test1.bag", 60.0, 120.0), 0.6
)
ASPHALT = BaseLog(
    "BorealTC asphalt", _file(ROBOTS / "husky_a200.toml", "mounts.imu_link", "topics"), boreal("ASPHALT", "00", 0.0, 60.0), 0.25
)
LOAM = BaseLog(
    "BorealTC sandy loam", _file(ROBOTS / "husky_a200.toml", "mounts.imu_link", "topics"), boreal("SANDY_LOAM", "01", 0.0, 60.0), 0.25
)
LEO = BaseLog("leo, laps", (ROBOTS / "leo.toml").read_text(), simulated("leo", "laps", 31, 0.0, 70.0))
SCOUT = BaseLog("scout_2, laps", (ROBOTS / "scout_2.toml").read_text(), simulated("scout_2", "laps", 32, 20.0, 80.0))
PIONEER = BaseLog("pioneer_3at, arcs", (ROBOTS / "pioneer_3at.toml").read_text(), simulated("pioneer_3at", "preliminary", 33, 0.0, 88.0))

# of the fourth set
STAIRS = BaseLog("fr079, 700 to 790 s", CORRIDOR.robot, real_building("fr079", "fr079.mcap", 700.0, 90.0))
LABS = BaseLog("MIT-CSAIL, 200 to 290 s", OFFICE.robot, real_building("mit-csail", "csail.mcap", 200.0, 90.0))
LOBBY = BaseLog("ACES, 700 to 790 s", HALL.robot, real_log("aces/aces.mcap", 700.0, 90.0))
PATH = BaseLog("Husky outdoors, 200 to 300 s", MEADOW.robot, real_log("husky-outdoor-gps/test1.bag", 200.0, 100.0), 0.5)
FLOORING = BaseLog("BorealTC flooring", ASPHALT.robot, boreal("FLOORING", "02", 0.0, 60.0), 0.25)
JACKAL = BaseLog("jackal, laps", (ROBOTS / "jackal.toml").read_text(), simulated("jackal", "laps", 91, 10.0, 70.0))
WARTHOG = BaseLog("warthog, arcs", (ROBOTS / "warthog.toml").read_text(), simulated("warthog", "preliminary", 92, 0.0, 80.0), 0.1)
ROVER = BaseLog("rover_pro, laps", (ROBOTS / "rover_pro.toml").read_text(), simulated("rover_pro", "laps", 93, 0.0, 75.0))
ROSBOT = BaseLog("rosbot_xl, laps", (ROBOTS / "rosbot_xl.toml").read_text(), simulated("rosbot_xl", "laps", 94, 5.0, 70.0))

# of the fifth set
WING = BaseLog("fr079, 300 to 390 s", CORRIDOR.robot, real_building("fr079", "fr079.mcap", 300.0, 90.0))
STUDIOS = BaseLog("MIT-CSAIL, 300 to 380 s", OFFICE.robot, real_building("mit-csail", "csail.mcap", 300.0, 80.0))
GALLERY = BaseLog("ACES, 1000 to 1090 s", HALL.robot, real_log("aces/aces.mcap", 1000.0, 90.0))
LOT = BaseLog("Husky outdoors, 290 to 390 s", MEADOW.robot, real_log("husky-outdoor-gps/test1.bag", 290.0, 100.0), 0.5)
ICE = BaseLog("BorealTC ice", ASPHALT.robot, boreal("ICE", "02", 0.0, 56.0), 0.25)
A300 = BaseLog("husky_a300, laps", (ROBOTS / "husky_a300.toml").read_text(), simulated("husky_a300", "laps", 95, 5.0, 70.0))
MINI = BaseLog("scout_mini, laps", (ROBOTS / "scout_mini.toml").read_text(), simulated("scout_mini", "laps", 96, 0.0, 75.0))
BURGER = BaseLog(
    "turtlebot3_burger, laps", (ROBOTS / "turtlebot3_burger.toml").read_text(), simulated("turtlebot3_burger", "laps", 97, 0.0, 75.0)
)
VAULT = BaseLog("vaultbot, arcs", (ROBOTS / "vaultbot.toml").read_text(), simulated("vaultbot", "preliminary", 98, 0.0, 80.0))

# of the sixth set
ANNEX = BaseLog("fr079, 850 to 930 s", CORRIDOR.robot, real_building("fr079", "fr079.mcap", 850.0, 80.0))
LIBRARY = BaseLog("MIT-CSAIL, 130 to 200 s", OFFICE.robot, real_building("mit-csail", "csail.mcap", 130.0, 70.0))
LOOP = BaseLog("ACES, 420 to 500 s", HALL.robot, real_log("aces/aces.mcap", 420.0, 80.0))
SNOW = BaseLog("BorealTC snow", ASPHALT.robot, boreal("SNOW", "03", 0.0, 35.0), 0.25)
A300_ARCS = BaseLog("husky_a300, arcs", A300.robot, simulated("husky_a300", "preliminary", 111, 0.0, 80.0))
ROSBOT_2 = BaseLog("rosbot, laps", (ROBOTS / "rosbot.toml").read_text(), simulated("rosbot", "laps", 112, 0.0, 70.0))
PIONEER_2 = BaseLog("pioneer_3dx, laps", (ROBOTS / "pioneer_3dx.toml").read_text(), simulated("pioneer_3dx", "laps", 113, 0.0, 70.0))
LEO_ARCS = BaseLog("leo, arcs", LEO.robot, simulated("leo", "preliminary", 114, 0.0, 80.0))


def trajectories(folder: Path) -> dict[str, Trajectory]:
    """Written trajectories by estimator."""
    found = {}
    for estimator in ("odometry", "ekf"):
        (path,) = folder.glob(f"*_{estimator}.tum")
        rows = [line.split() for line in path.read_text().splitlines() if line[:1] not in "#"]
        table = np.array([[float(v) for v in row[1:]] for row in rows])
        poses = np.column_stack([table[:, :2], 2.0 * np.arctan2(table[:, 5], table[:, 6])])
        stamps = [int(row[0].replace(".", "")) for row in rows]  # with nanoseconds, which a double does not resolve
        found[estimator] = Trajectory(np.array(stamps, dtype=np.int64), poses)
    return found


def error_of(ours: Trajectory, truth: Trajectory) -> float:
    """Absolute trajectory error [m] at the true poses' times; infinite where less than nine tenths of these are in ``ours``."""
    inside = (truth.stamps_ns >= ours.stamps_ns[0]) & (truth.stamps_ns <= ours.stamps_ns[-1])
    if inside.mean() < 0.9:
        return math.inf
    true, at = truth.poses[inside], ours.at(truth.stamps_ns[inside])
    moved = se2.compose(align(at, true[:, :2], true[:, 2]), at)
    return float(np.sqrt(np.mean(np.sum((moved - true)[:, :2] ** 2, axis=1))))


@dataclass(frozen=True, eq=False)
class Healthy:
    """What the log with nothing wrong gives."""

    errors: dict[str, float]
    truth: dict[str, Trajectory]
    reference: Trajectory
    """True poses, else the EKF's."""


@functools.cache
def healthy(base: BaseLog) -> Healthy:
    """Errors, and true poses, of a base log."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log, robot, truth = written(folder, base, lambda records: records)
        code, text = replayed(folder, log, robot)
        assert code == 0, text
        found = trajectories(folder / "out")
    known = found if truth is None else dict.fromkeys(found, truth)
    return Healthy({k: error_of(found[k], known[k]) for k in found}, known, found["ekf"] if truth is None else truth)


def written(
    folder: Path, base: BaseLog, edit: Edit, robot: Callable[[str], str] = lambda text: text
) -> tuple[Path, Path, Trajectory | None]:
    """Log and robot file, and the true poses."""
    records, truth = base.load()
    changed = edit(records)
    is_ordered = getattr(edit, "keeps_order", False)
    ordered = changed if is_ordered else sorted(changed, key=lambda record: record[2])
    write = getattr(edit, "write", lambda path, them: bags.write_mcap(path.with_suffix(".mcap"), them))
    path = write(folder / "log", ordered)
    (folder / "robot.toml").write_text(robot(base.robot))
    return path, folder / "robot.toml", truth


def based(
    kind: str,
    name: str,
    base: BaseLog,
    edit: Edit = lambda records: records,
    words: Sequence[str] = (),
    refused: bool = False,
    robot: Callable[[str], str] = lambda text: text,
    is_open: bool = False,
) -> Case:
    """A changed base log: right where odometry and EKF are as good as with nothing wrong, and a warning has one of ``words``.

    ``is_open``: two sensors contradict each other and nothing in the log decides, so that words alone are right.
    """

    def judge(folder: Path) -> Found:
        log, path, _ = written(folder, base, edit, robot)
        code, text = replayed(folder, log, path)
        warned = warnings_in(text)
        is_named = any(word in warned for word in words) if words else True
        if code:
            return Found(choose_outcome(refused, is_named, True, words), f"[exit {code}] {warned or text}")
        best, found = healthy(base), trajectories(folder / "out")
        ours = {k: error_of(found[k], best.truth[k]) for k in found}
        is_right = is_open or (not refused and all(ours[k] < 1.3 * best.errors[k] + base.tolerance_m for k in ours))
        state = "[" + ", ".join(f"{k} {ours[k]:.3f} ({best.errors[k]:.3f})" for k in ours) + " m]"
        is_named = is_named or (is_right and bool(warned))  # what is corrected to the true motion is named by whatever sentence says so
        outcome = choose_outcome(is_right, is_named, bool(warned), words)
        checked = "" if outcome == "right" else f" check: {contradictions(folder, log, path)}"
        return Found(outcome, f"{state}{checked}\n{warned}")

    return Case(kind, name, judge)


def referred(
    name: str,
    base: BaseLog,
    content: Callable[[Trajectory], str],
    suffix: str = "tum",
    words: Sequence[str] = (),
    edit: Edit = lambda records: records,
    reference: str = "",
    noise_m: float = 0.0,
    is_corrected: bool = False,
) -> Case:
    """A reference (a file, or topic ``reference``) of a base log.

    Right where the runs have the errors of the healthy log, or sentences have all of ``words``, which name a correction or contradiction.
    """

    def judge(folder: Path) -> Found:
        log, robot, _ = written(folder, base, edit)
        path, best = folder / f"reference.{suffix}", healthy(base)
        path.write_text(content(best.reference))
        code, text = replayed(folder, log, robot, "--reference", reference or str(path), "--json", str(folder / "m.json"))

        def wanted() -> dict[str, float]:
            own = error_of(best.truth["ekf"], best.reference)
            return {"ekf": best.errors["ekf"] or own, **({} if base.load()[1] is None else {"odometry": best.errors["odometry"]})}

        return judge_scores(code, text, folder / "m.json", words, wanted, noise_m, is_corrected)

    return Case("references", name, judge)


def recommended(name: str, base: BaseLog, cut: tuple[float, float], has_reference: bool) -> Case:
    """Scans are missing for a while.

    Right where, by a reference, the run of the smallest error is called best; without one, no run that lost its LiDAR.
    """

    def drop(records: list[Record]) -> list[Record]:
        return [r for r in records if r[0] != "/scan" or not START + cut[0] * S < r[2] < START + cut[1] * S]

    def judge(folder: Path) -> Found:
        log, robot, _ = written(folder, base, drop)
        known = healthy(base).reference
        rows = np.column_stack(
            [known.poses[:, :2], np.zeros((len(known.poses), 3)), np.sin(known.poses[:, 2] / 2), np.cos(known.poses[:, 2] / 2)]
        )
        lines = (f"{stamp / S:.7f} " + " ".join(f"{v:.7f}" for v in row) for stamp, row in zip(known.stamps_ns.tolist(), rows, strict=True))
        (folder / "reference.tum").write_text("\n".join(lines) + "\n")
        model = "diff_drive" if 'drive = "diff_drive"' in base.robot else "skid_steer"
        options = ["--reference", str(folder / "reference.tum")] if has_reference else []
        given = ["--model", model, "--estimator", "odometry,lidar,ekf,graph", "--json", str(folder / "m.json")]
        code, text = run_command("replay", str(log), "--robot", str(robot), "--out", str(folder / "out"), *given, *options)
        flat = " ".join(text.split())
        if code:
            return Found("misnamed", f"[exit {code}] {text}")
        if not has_reference:
            is_right = "is best" not in flat and "Not recommended" in flat and "ekf" in flat.split("Not recommended")[1].lower()
            return Found("right" if is_right else "misnamed", text)
        found = {r["estimator"]: r["ate_rmse_m"] for r in json.loads((folder / "m.json").read_text())["results"]}
        sentence = next((s for s in flat.split(". ") if "is best" in s or "has the smallest error" in s), "")
        best = min(found, key=lambda k: found[k])
        words = {"ekf": "EKF", "graph": "graph", "lidar": "LiDAR", "odometry": "dead reckoning"}
        is_right = words[best].lower() in sentence.split(" is best")[0].split(" has the")[0].lower() and "Not recommended" not in flat
        return Found("right" if is_right else "misnamed", f"[{found}] {text}")

    return Case("recommendation", name, judge)

"""The data of a diagnosis: windows of wheel motion with what LiDAR, gyro and accelerometers measured, or runs under a controller.

Of runs of a trajectory under a controller only the vision error was measured (Ebersole 2016, sec. 5.2 and Table 5-2). One line of a table
is a run: trajectory, arm_configuration, controller and vision_error_m, the mean distance between the path that was driven and that of
the controller's odometry. Wheel rates follow from command and controller, the odometry's path from the controller's own model.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from localization.calibration.calibrate import MotionReferenceName, estimate_antenna, make_motion_reference
from localization.calibration.motion_references import GyroMotionReference, LidarMotionReference, MotionReference, Span, Wheels
from localization.calibration.position_reference import PositionMotionReference
from localization.calibration.windows import WindowConfig, Windows, cut
from localization.diagnosis.recorded_signals import Signal, read_signals
from localization.events import Event, ImuSample, Scan, WheelSample
from localization.inputs.gyro import GyroRecord, is_gravity
from localization.logs.reader import Log
from localization.messages import Message, message
from localization.simulation.experiments import CONFIGURATION_CGS, CONTROLLERS, TRAJECTORIES
from motion_models import se2
from motion_models.calibration.maneuvers import IntArray, Maneuver, read_rows
from motion_models.center_of_gravity.files import arms_model
from motion_models.center_of_gravity.parts import Payload
from motion_models.errors import CalibrationError, SkidlocError
from motion_models.registry import make_model
from motion_models.robot import Mount, Robot
from motion_models.se2 import FloatArray

_NS = 1e-9
CgSource = Literal["topic", "arms", "constant", "table"]
_GRIPPERS = ("left_gripper", "gripper", "tool0", "left_tool0")
_MAX_STANDSTILL_RATE = 0.05  # rad/s; five sigma of plausible gyro biases (`causes`): a robot that turns while its wheels stand
_MIN_REGULAR_SHARE = 0.6  # of the intervals between messages that must be near their median for messages to have a period
_FEWEST_GAPS = 50
_SHORT_GAPS = 0.2  # quantile of the gaps that is the period where up to four fifths of the messages are missing at random
_MULTIPLE, _MIN_MULTIPLES_SHARE = 0.15, 0.9  # a gap so near a multiple of the period fits it (of any gaps 30 % do); share that must
_MAX_PAUSE_S = 5.0  # longer gaps are pauses of the driver, not lost messages

COLUMNS = ("trajectory", "arm_configuration", "controller", "vision_error_m")
_STEP_S = 0.05
_SIGMA_M = 0.01  # of a vision error, before the runs' own scatter is estimated


class EncoderLoss(NamedTuple):
    """What the encoder of a wheel joint lost, which the other wheels of its side replaced."""

    joint: str
    share: float
    """Share of the messages in which wheels roll."""
    spells: int


class MessageLoss(NamedTuple):
    """Messages of the wheels that are missing, by the gaps between their stamps."""

    share: float
    gaps: int
    longest_s: float
    period_s: float
    held_s: float
    """Age of the newest message in gaps, on average over the whole drive [s]: speeds that change meanwhile are late."""


class StandstillTurn(NamedTuple):
    """Turning by the gyro while no wheel moved."""

    seconds: float
    angle_rad: float
    first_s: float
    """Start of the first such standstill, after that of the first window in which the robot moved."""


@dataclass(frozen=True)
class Drive:
    """Maneuvers in order of time, and what else was measured in each; all arrays follow the maneuvers."""

    name: str
    robot: Robot
    maneuvers: tuple[Maneuver, ...]
    motion_reference: str
    """Name of the motion reference, for messages."""
    kind: str = "log"
    """log, windows, rotations or runs."""
    starts_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    """(W,) when each maneuver began, after the first one [s]; for tables, how much was driven before."""
    spans_ns: IntArray = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    """(W, 2) start and end stamps; (0, 2) for tables."""
    gyro: GyroRecord | None = None
    """All of the gyro; None without one, or where it is itself the motion reference."""
    is_gyro_reference: bool = False
    forces: FloatArray | None = None
    """(W, 2) mean specific force along the body's x and y over each maneuver [m/s^2]; None without accelerometers."""
    cg_source: CgSource = "constant"
    """Where the centre of gravity comes from: its topic, the arms' joint states, the robot file's constant, or the table."""
    payload_arms: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    """(N, 2) from the CG to where a payload would be held, in each interval of the maneuvers end to end [m]."""
    payload_link: str = ""
    """Link of the arms at which `payload_arms` puts it; empty where that is the front edge."""
    paths: tuple[FloatArray, ...] = ()
    """For runs: (n, 3) path of the controller's odometry in each, a pose at the end of each interval."""
    path_errors: FloatArray = field(default_factory=lambda: np.zeros(0))
    """For runs: (W,) measured mean distance of the driven path from the path of the controller's odometry [m]."""
    range_slopes: FloatArray | None = None
    """(W, 3) change of the measured motion per metre that is added to all ranges; None where no LiDAR measured it."""
    message_loss: MessageLoss | None = None
    encoder_losses: tuple[EncoderLoss, ...] = ()
    rolling_messages: int = 0
    """Messages of the wheels in which these had turned since the one before."""
    standstill_turn: StandstillTurn | None = None
    is_lidar_reference: bool = True
    """Whether the LiDAR measured the motion: of tables, whose motion was measured by scan matching, too."""
    lidar_frame: str = ""
    """Frame of the scans that were matched."""
    lidar_mount: Mount | None = None
    """Mount of `lidar_frame`; None for tables."""
    lidar_at: tuple[float, float] = (0.0, 0.0)
    """x and y of the LiDAR in the body frame, by its mount [m]; (0, 0) where a reference measured the motion."""
    antenna: tuple[float, float] = (0.0, 0.0)
    """x and y in the body frame of the antenna, for positions without headings [m]."""
    encoder_step_rad: float = 0.0
    """Step of the wheels' encoders [rad]; 0 where it is not known."""
    signals: tuple[Signal, ...] = ()
    """What else the log has along time, and parameters may follow."""
    set_up: tuple[Message, ...] = ()
    """How the log's sensors are set up otherwise than the robot file had it: `robot` has that corrected."""
    warnings: tuple[Message, ...] = ()

    @property
    def has_positions(self) -> bool:
        """Whether the motion reference measured positions anywhere, and not headings alone."""
        return any(bool(np.isfinite(m.cov[..., 0, 0]).any()) for m in self.maneuvers)

    @property
    def has_headings(self) -> bool:
        """Whether the motion reference measured headings, and not positions alone."""
        return not any(m.middle for m in self.maneuvers)


class _Recorder:
    """A motion reference that records which spans became maneuvers, and when the wheels stood."""

    def __init__(self, inner: MotionReference) -> None:
        self._inner = inner
        self.used: list[Span] = []
        self.standstills: list[tuple[int, int]] = []

    def spans(self, event: Event, wheels: Wheels) -> Iterator[Span]:
        for span in self._inner.spans(event, wheels):
            standstill = wheels.standstill(span.start_ns, span.end_ns)
            self.standstills += [] if standstill is None else [standstill]
            yield span

    def correct(self, spans: Sequence[Span]) -> list[Span]:
        self.used = list(spans)
        return self._inner.correct(spans)

    def warnings(self) -> list[Message]:
        return self._inner.warnings()

    def range_slopes(self) -> FloatArray | None:
        """See `Drive.range_slopes`."""
        slopes = [s.range_slope for s in self.used]
        if not any(slope is not None for slope in slopes):
            return None
        return np.array([np.zeros(3) if slope is None else slope for slope in slopes])


class ImuRecord:
    """The gyro's and the accelerometers' whole record.

    An accelerometer at r off the body's origin measures f + alpha x r + omega x (omega x r), f the specific force there (Titterton & Weston
    2004, sec. 3.5); about the vertical alone the planar part is f + alpha (-r_y, r_x) - omega^2 (r_x, r_y).
    """

    def __init__(self, robot: Robot, mounts: Any) -> None:
        self._mounts = mounts
        self.gyro = GyroRecord(robot.gyro_noise, mounts)
        self.stamps: list[int] = []
        self.forces: list[FloatArray] = []
        self._rates: list[float] = []
        self._at = np.zeros(2)

    def insert(self, sample: ImuSample) -> None:
        """Append ``sample``; samples come in order of time."""
        self.gyro.insert(sample)
        self.stamps.append(sample.stamp_ns)
        mount = self._mounts.get(sample.frame_id, Mount())
        rotation = mount.rotation
        self._at = np.array([mount.x, mount.y])
        self.forces.append(rotation @ sample.linear_acceleration)
        self._rates.append(float(rotation[2] @ sample.angular_velocity))

    def means(self, spans: IntArray) -> FloatArray | None:
        """(W, 2) mean force in each span at the body's origin; None where gravity is not upright, or missing."""
        if not self.stamps:
            return None
        stamps, forces = np.array(self.stamps), np.array(self.forces)
        if not is_gravity(float(np.median(forces[:, 2]))):
            return None
        rates = np.array(self._rates)
        planar = forces[:, :2] + rates[:, None] ** 2 * self._at
        total = np.vstack([np.zeros(2), np.cumsum(planar, axis=0)])
        a, b = np.searchsorted(stamps, spans[:, 0]), np.searchsorted(stamps, spans[:, 1])
        if np.any(b - a < 3):
            return None
        angular = (rates[b - 1] - rates[a]) / ((stamps[b - 1] - stamps[a]) * _NS)
        return np.asarray((total[b] - total[a]) / (b - a)[:, None] - angular[:, None] * np.array([-self._at[1], self._at[0]]))


class _Postures:
    """The log's model of the arms, which also records the joints of each centre of gravity."""

    def __init__(self, model: Any, offset: FloatArray) -> None:
        self._model, self.chain, self._offset = model, model.chain, offset
        self.joints: dict[tuple[float, float], FloatArray] = {}

    def estimate(self, positions: FloatArray) -> Any:
        found = self._model.estimate(positions)
        x, y = (found.position + self._offset).tolist()
        self.joints.setdefault((x, y), np.array(positions))
        return found

    def __getattr__(self, name: str) -> Any:
        return getattr(self._model, name)


def drive_of_log(
    log: Log,
    motion_reference: MotionReferenceName = "auto",
    reference: str | None = None,
    config: WindowConfig | None = None,
    reference_sigmas: tuple[float, float] | None = None,
    antenna: tuple[float, float] | None = None,
) -> Drive:
    """Read ``log`` once; ``reference_sigmas`` is the noise of the reference's poses [m, rad], by default what it gives itself, and
    ``antenna`` as in `make_motion_reference`.

    Raises `CalibrationError` where it has no wheels, and for a ``motion_reference`` that it does not have.
    """
    config = config or WindowConfig()
    robot = log.robot
    if log.sources.wheels is None and log.wheels_error is None:
        raise CalibrationError(
            f"{log.path.name} has {log.no_wheels or 'no wheels by these options.'} Name them with --topic.joint-states or --topic.odometry."
        )
    if motion_reference == "auto" and reference is None and log.sources.lidar is None and log.sources.imu is None:
        alone = message("measured_motion.nothing", log=log.path.name)
        return Drive(log.path.name, robot, (), "none", warnings=(alone, *log.warnings()))
    inner = make_motion_reference(log, robot, motion_reference, reference, config, reference_sigmas, antenna)
    postures = None
    if log._arms is not None:
        postures = _Postures(log._arms, robot.geometry.cg_offset)
        log._arms = postures  # type: ignore[assignment]
    drive = drive_of_events(log.events(), log.path.name, robot, log.mounts, inner, config, postures)
    if isinstance(inner[0], PositionMotionReference) and not inner[0].is_antenna_known and drive.maneuvers:
        (x, y), (sigma_x, sigma_y) = estimate_antenna(drive.maneuvers, robot)
        inner = inner[0].with_guess((x, y)), inner[1]
        note = message("measured_motion.antenna", x=x, y=y, sigma_x=sigma_x, sigma_y=sigma_y)
        drive = drive_of_events(log.events(), log.path.name, robot, log.mounts, inner, config, postures)
        drive = dataclasses.replace(drive, warnings=(*drive.warnings, note))
    losses = tuple(EncoderLoss(f.joint, f.messages / max(drive.rolling_messages, f.messages), f.spells) for f in log.frozen_wheels())
    source: CgSource = "topic" if log.sources.center_of_gravity is not None else "arms" if log.sources.arms else "constant"
    notes = log.warnings()
    set_up = tuple(note for note in notes if note.id.startswith("set_up."))
    rest = tuple(note for note in notes if note not in set_up)
    drive = dataclasses.replace(drive, signals=read_signals(log), set_up=set_up, warnings=(*drive.warnings, *rest))
    return dataclasses.replace(drive, encoder_losses=losses, cg_source=source)


def drive_of_events(
    events: Iterable[Event],
    name: str,
    robot: Robot,
    mounts: Mapping[str, Mount],
    reference: tuple[MotionReference, str],
    config: WindowConfig,
    postures: _Postures | None = None,
) -> Drive:
    """Cut ``events`` into windows whose motion the ``reference`` (and its name) measures, and store what else was measured in each."""
    inner, words = reference
    recorder, imu = _Recorder(inner), ImuRecord(robot, mounts)
    frame = ""
    wheel_stamps: list[int] = []
    wheel_angles: list[FloatArray] = []

    def record_events() -> Iterable[Event]:
        nonlocal frame
        for event in events:
            if isinstance(event, ImuSample):
                imu.insert(event)
            elif isinstance(event, WheelSample):
                wheel_stamps.append(event.stamp_ns)
                wheel_angles.append(event.position)
            elif isinstance(event, Scan):
                frame = event.frame_id
            yield event

    windows = cut(record_events(), recorder, make_model("diff_drive", robot), robot, config, name)
    spans = np.array([(s.start_ns, s.end_ns) for s in recorder.used], dtype=np.int64).reshape(-1, 2)
    left = _describe_windows(windows, spans, config)
    by_gyro, by_lidar = isinstance(inner, GyroMotionReference), isinstance(inner, LidarMotionReference)
    mount = mounts.get(frame, Mount()) if by_lidar else Mount()
    by_positions = isinstance(inner, PositionMotionReference)
    has_gyro = bool(imu.stamps) and not by_gyro and not by_positions  # it is compared with measured headings
    return Drive(
        name=name,
        robot=robot,
        maneuvers=windows.maneuvers,
        motion_reference=words,
        starts_s=(spans[:, 0] - spans[0, 0]) * _NS if len(spans) else np.zeros(0),
        spans_ns=spans,
        gyro=imu.gyro if has_gyro else None,
        is_gyro_reference=by_gyro,
        forces=imu.means(spans) if has_gyro and len(spans) else None,
        payload_arms=_payload_arms(robot, windows.maneuvers, postures),
        payload_link=_gripper(postures),
        range_slopes=recorder.range_slopes(),
        message_loss=find_message_loss(np.array(wheel_stamps, dtype=np.int64)),
        rolling_messages=int(np.count_nonzero(np.diff(np.reshape(wheel_angles, (-1, 2)), axis=0).any(axis=1))),
        standstill_turn=find_standstill_turn(imu.gyro, recorder.standstills, spans) if imu.stamps else None,
        is_lidar_reference=by_lidar,
        lidar_frame=frame,
        lidar_mount=mount if by_lidar else None,
        lidar_at=(mount.x, mount.y),
        antenna=inner.antenna if isinstance(inner, PositionMotionReference) else (0.0, 0.0),
        encoder_step_rad=windows.step_rad,
        warnings=(left, *([_describe_gaps(imu.gyro)] if imu.gyro.gaps else []), *windows.warnings),
    )


def _describe_gaps(gyro: GyroRecord) -> Message:
    if gyro.gaps == 1:
        return message("measured_motion.gap", silent_s=gyro.silent_s)
    return message("measured_motion.gaps", count=gyro.gaps, silent_s=gyro.silent_s)


def _describe_windows(windows: Windows, spans: IntArray, config: WindowConfig) -> Message:
    length_s = float(np.median(spans[:, 1] - spans[:, 0])) * _NS if len(spans) else config.window_s
    if length_s > 1.3 * config.window_s and not any(m.middle for m in windows.maneuvers):
        return message("measured_motion.sparse", length_s=length_s, window_s=config.window_s, **windows.counts)
    return message("measured_motion.windows", length_s=length_s, **windows.counts)


def find_message_loss(stamps: IntArray) -> MessageLoss | None:
    """Missing messages by gaps in ``stamps`` (n,) [ns]; None where messages come at no regular rate."""
    gaps = np.diff(stamps) * _NS
    period = find_period(gaps)
    if period is None:
        return None
    holes = gaps[(gaps > 1.6 * period) & (gaps < _MAX_PAUSE_S)]
    missing = float(np.sum(np.round(holes / period) - 1.0))
    held_s = float(np.sum(holes**2) / (2.0 * np.sum(gaps)))
    return MessageLoss(missing / (missing + len(stamps)), len(holes), float(holes.max(initial=0.0)), period, held_s)


def find_period(gaps: FloatArray) -> float | None:
    """The time from message to message, by the ``gaps`` (n,) between them [s]: their median where most are near it; where many messages are
    missing, a shorter one of which nearly all are multiples; else None."""
    if len(gaps) < _FEWEST_GAPS:
        return None
    period = float(np.median(gaps))
    if period > 0.0 and float(np.mean(np.abs(gaps - period) < 0.3 * period)) >= _MIN_REGULAR_SHARE:
        return period
    short = float(np.quantile(gaps, _SHORT_GAPS))
    if short <= 0.0:
        return None
    period = float(np.median(gaps[np.abs(gaps - short) < 0.3 * short]))
    multiples = gaps / period
    is_multiple = np.abs(multiples - np.maximum(np.round(multiples), 1.0)) < _MULTIPLE
    return period if float(is_multiple.mean()) >= _MIN_MULTIPLES_SHARE else None


def find_standstill_turn(gyro: GyroRecord, standstills: Sequence[tuple[int, int]], moving: IntArray) -> StandstillTurn | None:
    """Turning by ``gyro`` in ``standstills``, from start to end [ns], in which no wheel moved; None where it stood as well. ``moving``
    (W, 2) are the windows in which the robot moved [ns]."""
    turns = [(start_ns, gyro.turn(start_ns, end_ns, 0.0)) for start_ns, end_ns in standstills]
    moved = [(start_ns, t) for start_ns, t in turns if t is not None and abs(t.angle) > _MAX_STANDSTILL_RATE * t.duration]
    if not moved:
        return None
    first = (moved[0][0] - (int(moving[0, 0]) if len(moving) else standstills[0][0])) * _NS
    return StandstillTurn(sum(t.duration for _, t in moved), sum(abs(t.angle) for _, t in moved), first)


def drive_of_table(name: str, robot: Robot, maneuvers: Sequence[Maneuver], kind: str) -> Drive:
    """Maneuvers of a table. Windows with several poses are cut at them, so that each counts for itself and the wheels before it are
    available.

    >>> from localization.diagnosis.diagnose import diagnose
    >>> from motion_models import load_robot, make_model, read_rotation_table, rotations_as_maneuvers
    >>> robot = load_robot("vaultbot")
    >>> rotations = rotations_as_maneuvers(read_rotation_table("tests/data/vaultbot/rotation_grid.csv"), robot)
    >>> found = diagnose(drive_of_table("rotation_grid.csv", robot, rotations, "rotations"), make_model("friction", robot))
    >>> strongest = found.findings[0]
    >>> strongest.cause, round(strongest.size, 2), strongest.definition.unit
    ('lidar_offset_x', 0.06, 'm')
    """
    factors = robot.geometry.radius_multipliers
    if (factors != 1.0).any():
        maneuvers = [dataclasses.replace(m, wheels=m.wheels * factors) for m in maneuvers]
    if kind == "windows":
        maneuvers = [piece for m in maneuvers for piece in _pieces(m)]
    seconds = np.array([float(m.dt[m.lead : m.lead + int(m.ends[-1])].sum()) for m in maneuvers])
    return Drive(
        name=name,
        robot=robot,
        maneuvers=tuple(maneuvers),
        motion_reference=f"the table of {len(maneuvers)} {kind}",
        kind=kind,
        cg_source="table",
        starts_s=np.asarray(np.cumsum(seconds) - seconds),
        payload_arms=_payload_arms(robot, maneuvers, None),
    )


def _pieces(m: Maneuver) -> Iterator[Maneuver]:
    """From pose to pose; what came before is lead."""
    before, driven = np.zeros(3), 0
    covs = np.broadcast_to(m.cov, (len(m.ends), 3, 3))
    for pose, end, cov in zip(m.measured, m.ends, covs, strict=True):
        both = cov if driven == 0 else 2.0 * cov  # two poses that err independently
        motion = se2.between(before, pose)[None]
        downhill = se2.rotation(-before[2]) @ m.downhill
        yield dataclasses.replace(m, measured=motion, ends=np.array([end - driven]), cov=both, lead=m.lead + driven, downhill=downhill)
        before, driven = pose, int(end)


def _gripper(postures: _Postures | None) -> str:
    """Link that holds a payload; empty for robots without arms."""
    return "" if postures is None else next((name for name in _GRIPPERS if name in postures.chain.links), "")


def _payload_arms(robot: Robot, maneuvers: Sequence[Maneuver], postures: _Postures | None) -> FloatArray:
    """(N, 2) lever of a payload about the CG: in the (left) gripper, or over the front edge of a robot without arms."""
    if not maneuvers:
        return np.zeros((0, 2))
    cg = np.concatenate([np.broadcast_to(m.cg, m.wheels.shape) for m in maneuvers])
    edge = np.array([robot.geometry.wheelbase_m / 2.0, 0.0])
    link = _gripper(postures)
    if postures is None or robot.arms is None or not link:
        return np.asarray(edge - cg)
    try:
        loaded = arms_model(robot.arms, robot.folder, Payload(link, 1.0))
    except SkidlocError:
        return np.asarray(edge - cg)
    unique, inverse = np.unique(cg, axis=0, return_inverse=True)
    levers = np.zeros_like(unique)
    known: dict[bytes, FloatArray] = {}
    for i, (x, y) in enumerate(unique):
        joints = postures.joints.get((float(x), float(y)))
        if joints is None:
            levers[i] = edge - unique[i]
            continue
        key = np.round(joints, 3).tobytes()
        if key not in known:
            estimate = loaded.estimate(joints)
            known[key] = (estimate.position + robot.geometry.cg_offset - unique[i]) * estimate.mass
        levers[i] = known[key]
    return np.asarray(levers[np.ravel(inverse)])


@dataclass(frozen=True)
class TableRun:
    """One line of the table."""

    trajectory: str
    arm_configuration: str
    controller: str
    vision_error_m: float


def read_runs(path: Path) -> list[TableRun]:
    """The table's runs. Raises `CalibrationError`, naming line and column."""
    columns, rows = read_rows(path)
    missing = [name for name in COLUMNS if name not in columns]
    if missing:
        raise CalibrationError(f"table '{path}' has no column {', '.join(missing)}; it has {', '.join(columns)}.")
    allowed = dict(zip(COLUMNS, (TRAJECTORIES, CONFIGURATION_CGS, CONTROLLERS), strict=False))
    found = []
    for line, cells in rows:
        for column, names in allowed.items():
            if cells[column] not in names:
                raise CalibrationError(f"table '{path}', line {line}: no {column} '{cells[column]}'; there are {', '.join(names)}.")
        try:
            error = float(cells["vision_error_m"])
        except ValueError:
            error = math.nan
        if not (math.isfinite(error) and error >= 0.0):
            raise CalibrationError(
                f"table '{path}', line {line}: vision_error_m must be a distance in metres, found {cells['vision_error_m']!r}."
            )
        found.append(TableRun(cells["trajectory"], cells["arm_configuration"], cells["controller"], error))
    if not found:
        raise CalibrationError(f"table '{path}' has no rows below its header.")
    return found


def drive_of_runs(name: str, robot: Robot, runs: list[TableRun]) -> Drive:
    """Each run as a maneuver that ends with the odometry's path."""
    maneuvers, paths = [], []
    for run in runs:
        profile, duration = TRAJECTORIES[run.trajectory]
        middles = (np.arange(round(duration / _STEP_S), dtype=np.float64) + 0.5) * _STEP_S
        command = profile(middles)
        cg = np.array(CONFIGURATION_CGS[run.arm_configuration])
        controller = make_model(run.controller, robot)
        wheels = controller.wheels(command, np.broadcast_to(cg, command.shape), controller.nominal)
        path = path_of(controller.twist(wheels, cg, controller.nominal).value * _STEP_S)
        n = len(middles)
        cov = np.diag([_SIGMA_M**2, math.inf, math.inf])
        maneuvers.append(Maneuver(np.full(n, _STEP_S), wheels, path[-1:], np.array([n]), cg, cov, group=run.arm_configuration))
        paths.append(path)
    drive = drive_of_table(name, robot, maneuvers, "runs")
    errors = np.array([run.vision_error_m for run in runs])
    note = message("measured_motion.runs")
    return dataclasses.replace(drive, paths=tuple(paths), path_errors=errors, warnings=(note,))


def path_of(steps: FloatArray) -> FloatArray:
    """(n, 3) poses after each of the ``steps`` (n, 3), twists times their durations."""
    moves = se2.exp(steps)
    poses = np.empty_like(moves)
    pose = np.zeros(3)
    for i, move in enumerate(moves):
        pose = se2.compose(pose, move)
        poses[i] = pose
    return poses

"""The estimator live: how long after a scan its estimate is out, what part of a core it takes, and whether its memory stays flat.

python -m tests.benchmarks.online [steps | latency | parts | start | quarter | starved [COMMIT] | dashboard | soak [HOURS [BEAMS]]]

`quarter` confines the node to a quarter of a core by a cgroup (as root), as a computer of the Raspberry Pi's class would; `starved` gives
it the weight of 25, 15 and 10 % of a core while all cores are busy, this tree beside that of a COMMIT.
"""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import numpy as np

from localization.events import Event
from localization.logs import Log, open_log
from localization.pipeline import Pipeline, ReplayConfig, Trial
from localization.ros import dashboard as dashboard_module
from localization.ros.dashboard import Dashboard
from localization.ros.jit_warm_up import WarmUp
from localization.ros.settings import LiveRun
from localization.simulation.experiments import ExperimentConfig
from localization.simulation.scanners import ScannerConfig
from localization.simulation.sensors import SensorConfig
from localization.simulation.simulator import SimulationConfig, simulate, write_simulation
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from tests.benchmarks.host import paced
from tests.benchmarks.online_parts import PartTimes, one_after_the_other, table
from tests.benchmarks.online_parts import over_dds as over_dds_by_parts
from tests.benchmarks.online_soak import soak
from tests.studies.buildings import BUILDINGS

BEAMS = 760
_TREE, _PERIOD_S = Path(__file__).parents[2], 0.08
"""This tree, and the scans' period [s]."""
_DASHBOARD_S, _PARTS_S = 40.0, 25.0
_READER = "import sys, urllib.request; urllib.request.urlopen(sys.argv[1]).read()"
_SETTLED_S = 3.0
"""What is heard at the start, before the first estimate, comes all at once."""


def write_laps(path: Path, laps: int = 1) -> Path:
    """Laps through four rooms with a planar scanner of 760 beams at 12.5 Hz."""
    scanner = ScannerConfig(beams=BEAMS)
    config = SimulationConfig(experiment=ExperimentConfig(laps=laps), sensors=SensorConfig(scanner=scanner))
    write_simulation(path, simulate("laps", load_robot("vaultbot"), 0, {}, config))
    return path


def in_process(path: Path, robot_name: str, estimator: str, model: str = "skid_steer") -> tuple[np.ndarray, float]:
    """Seconds from each event that completes an estimate, and CPU per second of the log."""
    robot = load_robot(robot_name)
    log = open_log(path, robot)
    pair, config = Trial(make_model(model, robot), estimator), ReplayConfig()
    WarmUp(LiveRun(robot, lambda has_lidar: pair, config=config)).wait()
    events, took = list(log.events()), []
    pipeline = Pipeline(pair, robot, log.mounts, True, config)
    begin = time.process_time()
    for event in events:
        start = time.perf_counter()
        if pipeline.process(event):
            took.append(time.perf_counter() - start)
            pipeline.run_deferred()
    cpu = time.process_time() - begin
    return np.array(took), cpu / ((events[-1].stamp_ns - events[0].stamp_ns) * 1e-9)


_FIRST_START = """
from localization.pipeline import Trial
from localization.ros import dashboard as dashboard_module
from localization.ros.dashboard import Dashboard
from localization.ros.jit_warm_up import WarmUp
from localization.ros.settings import LiveRun
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
robot = load_robot("husky_a200")
WarmUp(LiveRun(robot, lambda has_lidar: Trial(make_model("skid_steer", robot), "ekf"))).wait()
"""


def first_start_seconds() -> tuple[float, float]:
    """Seconds from the start of a process until all kernels are ready: compiled, and loaded from the cache."""
    took = []
    with tempfile.TemporaryDirectory() as cache:
        for _ in range(2):
            begin = time.perf_counter()
            subprocess.run([sys.executable, "-c", _FIRST_START], check=True, env={**os.environ, "NUMBA_CACHE_DIR": cache})
            took.append(time.perf_counter() - begin)
    return took[0], took[1]


def steps() -> None:
    """Real logs in this process: what a step takes, and the graph beside the filter."""
    print("event in, estimate out                              p50 ms    p99 ms    max ms    part of a core")
    for name, building in BUILDINGS.items():
        for estimator in ("ekf", "graph"):
            _print(f"{name}: {estimator}", *in_process(building.log, building.robot, estimator, "diff_drive"))
    compiled, loaded = first_start_seconds()
    print(f"first start of the node: {compiled:.1f} s, each later one {loaded:.1f} s")
    print("wanted: p99 <= 5 ms, first start <= 10 s\n")


def start_peer(path: Path, domain: str) -> subprocess.Popen[str]:
    """The robot of ``path`` on DDS; it plays as soon as a node is there and a line with the seconds was written to it."""
    command = [sys.executable, "-m", "tests.helpers.dds_peer", str(path), domain]
    peer = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert peer.stdout is not None
    peer.stdout.readline()
    return peer


def play(peer: subprocess.Popen[str], seconds: int) -> None:
    """Begin to play, as soon as a node is there."""
    assert peer.stdin is not None
    peer.stdin.write(f"{seconds}\n")
    peer.stdin.flush()


def start_node(domain: str, *options: str, tree: Path = _TREE) -> subprocess.Popen[str]:
    """The node on DDS, by the code of a ``tree``."""
    command = (sys.executable, "-m", "localization.cli", "online", "--robot", "vaultbot", "--transport", "dds", "--domain", domain)
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    return subprocess.Popen([*command, *options], cwd=tree, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment)


class OverDds(NamedTuple):
    """What a robot on DDS has seen of the node."""

    out_s: np.ndarray
    """From each scan on the wire to its odometry on the wire [s]."""
    heard_s: np.ndarray
    """The same as another process sees it, which writes the one and reads the other in Python [s]."""
    cpu: float
    """The node's part of a core."""
    answered: int
    sent: int
    """Scans."""
    predicted: int
    """Predicted odometry."""
    reports: Sequence[str]
    """What the node has printed since the robot began to drive."""


_DOMAIN = "97"
_SHARES = (0.25, 0.15, 0.10)
"""Parts of a core that `starved` gives."""


def over_dds(
    path: Path, estimator: str, folder: Path, around: Callable[[int], AbstractContextManager[None]] | None = None, tree: Path = _TREE
) -> OverDds:
    """A minute of ``path`` on DDS, with the node of ``tree``, once it has compiled; ``around`` gives the context for its process."""
    peer = start_peer(path, _DOMAIN)
    state = Path(tempfile.mkdtemp(dir=folder)) / "state"
    node = start_node(_DOMAIN, "--estimator", estimator, "--node.wait-s", "1", "--state", str(state), tree=tree)
    assert node.stdout is not None
    for _ in ("listening", "waiting for topics, with everything compiled"):
        node.stdout.readline()
    return _measure(peer, node, None if around is None else around(node.pid))


def without_estimator(path: Path) -> OverDds:
    """The same with `dds_relay` in the node's place: what the transport costs by itself."""
    peer = start_peer(path, _DOMAIN)
    relay = subprocess.Popen([sys.executable, "-m", "tests.helpers.dds_relay", _DOMAIN], stdout=subprocess.PIPE, text=True)
    assert relay.stdout is not None
    assert relay.stdout.readline() == "listening\n"
    return _measure(peer, relay)


def _measure(peer: subprocess.Popen[str], node: subprocess.Popen[str], inside: AbstractContextManager[None] | None = None) -> OverDds:
    """Play a minute ``inside`` of a context, and end both processes."""
    assert peer.stdout is not None
    with inside or nullcontext():
        before, begin = _cpu_seconds(node.pid), time.monotonic()
        play(peer, 60)
        peer.stdout.readline()  # matched
        peer.stdout.readline()  # played
        cpu = (_cpu_seconds(node.pid) - before) / (time.monotonic() - begin)
    heard = json.loads(peer.communicate()[0])
    node.terminate()
    reports = [line for line in node.communicate()[0].splitlines() if line.startswith("!")]
    settled = int(_SETTLED_S * 12.5)
    out_s, heard_s = (np.array(heard[name])[settled:] for name in ("out_s", "latencies_s"))
    return OverDds(out_s, heard_s, cpu, len(heard["out_s"]), len(heard["scans"]), len(heard["predicted_stamps"]), reports)


_PERIOD_US = 100_000
"""Of the quota, the kernel's default [us]."""


@contextmanager
def _in_group(pid: int, settings: Mapping[str, str], settings_v1: Mapping[str, str]) -> Iterator[Path]:
    """Inside, a process and its threads are in a cgroup with ``settings`` by file (v2, else v1). Raises `OSError` where there is none."""
    root = Path("/sys/fs/cgroup")
    is_v2 = (root / "cgroup.controllers").exists()
    group = (root if is_v2 else root / "cpu") / "skidloc-benchmark"
    group.mkdir(exist_ok=True)
    for name, value in (settings if is_v2 else settings_v1).items():
        (group / name).write_text(value)
    try:
        (group / "cgroup.procs").write_text(str(pid))
        yield group
    finally:
        for member in (group / "cgroup.procs").read_text().split():  # with the node's own processes
            (group.parent / "cgroup.procs").write_text(member)
        group.rmdir()


@contextmanager
def _confined(pid: int, share: float) -> Iterator[None]:
    """Inside, all threads of a process have a ``share`` of a core, whatever others do."""
    quota_us = round(share * _PERIOD_US)
    v1 = {"cpu.cfs_period_us": str(_PERIOD_US), "cpu.cfs_quota_us": str(quota_us)}
    with _in_group(pid, {"cpu.max": f"{quota_us} {_PERIOD_US}"}, v1) as group:
        yield
        throttled = dict(line.split() for line in (group / "cpu.stat").read_text().splitlines())["nr_throttled"]
        print(f"confined to {share:g} of a core: throttled in {throttled} periods of {_PERIOD_US // 1000} ms")


@contextmanager
def _beside_load(pid: int, share: float) -> Iterator[None]:
    """Inside, a process that wants it has a ``share`` of a core beside another one that never waits there."""
    weight = share / (1.0 - share)
    with _in_group(pid, {"cpu.weight": f"{100.0 * weight:.0f}"}, {"cpu.shares": f"{1024.0 * weight:.0f}"}):
        yield


def quarter() -> None:
    """The node on a quarter of a core: whether each scan is answered, and how late."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        found = over_dds(write_laps(folder / "laps.mcap"), "ekf", folder, lambda pid: _confined(pid, 0.25))
    print(f"{BEAMS} beams at 12.5 Hz, a quarter of a core            p50 ms    p99 ms    max ms    part of a core")
    _print("ekf: scan sent, odometry sent, over DDS", found.out_s, found.cpu)
    print(f"{found.answered} of {found.sent} scans answered. wanted: all but those of the last moment, p99 <= 40 ms\n")


@contextmanager
def _busy_cores() -> Iterator[None]:
    """Inside, each core has a process that never waits."""
    processes = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(os.cpu_count() or 1)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def starved(commit: str = "") -> None:
    """The node beside processes that keep all cores busy, with the weight of a part of a core: which scans are answered, how late, and what
    it reports; beside the tree of ``commit``, if one is given."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path, trees = write_laps(folder / "laps.mcap"), {"this tree": _TREE}
        if commit:
            trees[commit] = folder / "tree"
            subprocess.run(["git", "worktree", "add", "--detach", str(folder / "tree"), commit], cwd=_TREE, check=True, capture_output=True)
        try:
            for share, (shown, tree) in itertools.product(_SHARES, trees.items()):
                with _busy_cores():
                    found = over_dds(path, "ekf", folder, partial(_beside_load, share=share), tree)
                in_time, rate_hz = float(np.mean(found.out_s <= _PERIOD_S)), found.predicted / 60.0
                _print(f"{shown}, {share:.0%} of a core", found.out_s, found.cpu)
                answered = f"{found.answered} of {found.sent} scans answered, {in_time:.1%} of these within a period"
                print(f"    {answered}; {rate_hz:.0f} predictions a second")
                for line in found.reports:
                    print(f"    {line}", flush=True)
        finally:
            if commit:
                subprocess.run(["git", "worktree", "remove", "--force", str(folder / "tree")], cwd=_TREE, check=True)
    print("wanted at 15 %: 99 % of the scans that are answered within a period, and no verdict about a sensor\n")


def start() -> None:
    """A robot that is already driving: from the start of the node to its first odometry by wheels (`~/odometry_predicted`) and by the
    estimator: seconds, those after the first scan on the wire, and CPU seconds of the node."""
    print("the node beside a robot that drives    first line s    by wheels s (after a scan, CPU)    estimator s (after a scan, CPU)")
    with tempfile.TemporaryDirectory() as cache:
        path = write_laps(Path(cache) / "laps.mcap", laps=2)
        for name in ("kernels compiled", "kernels from the cache"):
            os.environ["NUMBA_CACHE_DIR"] = cache
            peer, begin, begin_wall = start_peer(path, "96"), time.monotonic(), time.time()
            play(peer, 90)
            node = start_node("96")
            assert node.stdout is not None
            with _cpu_over_time(node.pid) as cpu:
                node.stdout.readline()
                first_line_s = time.monotonic() - begin
                report = json.loads(peer.communicate()[0].splitlines()[-1])
            node.terminate()
            node.communicate()
            if not report["arrivals_s"]:
                print(f"{name:56}{first_line_s:12.1f}  no odometry within 90 s", flush=True)
                continue
            by_wheels_s, estimator_s = report["first_predicted_s"] - begin_wall, report["arrivals_s"][0] - begin
            heard_s, columns = report["scans"][0][1] - begin, ""
            for out_s in (by_wheels_s, estimator_s):
                cpu_s = np.interp(begin + out_s, *zip(*cpu, strict=True))
                columns += f"{out_s:14.1f} ({out_s - heard_s:4.1f}, {cpu_s:5.2f})"
            print(f"{name:36}{first_line_s:15.1f}{columns}", flush=True)
    print("wanted: first odometry within 1 s of CPU, the estimator within 8 s with kernels from the cache\n")


_CPU_PERIOD_S = 0.02


@contextmanager
def _cpu_over_time(pid: int) -> Iterator[Sequence[tuple[float, float]]]:
    """Time of the monotonic clock and CPU seconds of a process, every fiftieth of a second inside."""
    found, ended = [(time.monotonic(), 0.0)], threading.Event()

    def watch() -> None:
        while not ended.wait(_CPU_PERIOD_S):
            found.append((time.monotonic(), _cpu_seconds(pid)))

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield found
    finally:
        ended.set()
        thread.join()


def _cpu_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def latency() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = write_laps(folder / "laps.mcap")
        print(f"{BEAMS} beams at 12.5 Hz, IMU and wheels at 50 Hz        p50 ms    p99 ms    max ms    part of a core")
        took = {}
        for estimator in ("ekf", "graph"):
            took[estimator], cpu = in_process(path, "vaultbot", estimator)
            _print(f"{estimator}: event in, estimate out", took[estimator], cpu)
        usual = float(np.median(took["ekf"]))
        _print(f"no estimator: a datagram in, {1e3 * usual:.1f} ms of sums", *paced(usual, 0.08, 700))
        try:
            import cyclonedds  # noqa: F401
        except ImportError:
            print("over DDS: the extra 'ros2' is not installed")
        else:
            found = without_estimator(path)
            _print("no estimator: scan sent, odometry sent, over DDS", found.out_s, found.cpu)
            for estimator in ("ekf", "graph"):
                found = over_dds(path, estimator, folder)
                _print(f"{estimator}: scan sent, odometry sent, over DDS", found.out_s, found.cpu)
                _print(f"{estimator}: scan written, odometry heard, over DDS", found.heard_s, found.cpu)
        print("wanted: p99 <= 5 ms, less than 0.10 of a core\n")


def parts() -> None:
    """The node's processor time by its parts, at a robot's pace over DDS and in the processor's caches."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path, paced, quick = write_laps(folder / "laps.mcap"), PartTimes(), PartTimes()
        peer = start_peer(path, _DOMAIN)
        of_robot = over_dds_by_parts(folder, _PARTS_S, int(_DOMAIN), lambda: play(peer, round(2.0 * _PARTS_S) + 15), paced)
        peer.terminate()
        peer.communicate()
        (folder / "state").unlink()
        for line in table((paced, *of_robot), (quick, *one_after_the_other(path, folder, quick))):
            print(line)
    print("wanted: less than 8 % of a core\n")


def dashboard() -> None:
    """CPU of the whole process, with its server's threads and a page that is open, over that of the estimator's steps alone; the page is
    sent by the robot's time, as live."""
    with tempfile.TemporaryDirectory() as name:
        log = open_log(write_laps(Path(name) / "laps.mcap"), load_robot("vaultbot"))
        events = list(itertools.takewhile(lambda event: event.stamp_ns < log.start_ns + _DASHBOARD_S * 1e9, log.events()))
        run_steps(log, events[: len(events) // 4], None)  # compiles
        page = Dashboard()
        reader = subprocess.Popen([sys.executable, "-c", _READER, page.address + "events"])
        seconds = {shown: run_steps(log, events, view) for view, shown in ((None, "alone"), (page, "with a page"), (None, "alone again"))}
        reader.wait(timeout=60)
        plain = 0.5 * (seconds["alone"] + seconds["alone again"])
        print(", ".join(f"{name}: {value:.2f} s" for name, value in seconds.items()), f"of CPU for {_DASHBOARD_S:.0f} s of driving")
        print(f"the page takes {100 * (seconds['with a page'] / plain - 1):.1f} % of the estimator's time\n")


def run_steps(log: Log, events: Sequence[Event], view: Dashboard | None) -> float:
    """CPU time of the process [s] for ``events``."""
    pipeline = Pipeline(Trial(make_model("skid_steer", log.robot), "ekf"), log.robot, log.mounts, True, ReplayConfig())
    if view is not None:
        view.begin(log.robot, log.mounts)
    begin = time.process_time()
    for event in events:
        estimates = pipeline.process(event)
        if view is not None:
            with mock.patch.object(dashboard_module.time, "monotonic", lambda now=event.stamp_ns * 1e-9: now):
                view.show(event, estimates, pipeline)
    if view is not None:
        view.show(None, [], pipeline)
        view.close()
    return time.process_time() - begin


def main(part: str = "all", *options: str) -> None:
    if part in ("all", "steps"):
        steps()
    if part in ("all", "latency"):
        latency()
    if part in ("all", "parts"):
        parts()
    if part in ("all", "start"):
        start()
    if part in ("all", "quarter"):
        quarter()
    if part in ("all", "starved"):
        starved(*options)
    if part in ("all", "dashboard"):
        dashboard()
    if part in ("all", "soak"):
        hours, beams = (*options, *("10", str(BEAMS))[len(options) :])
        soak(float(hours), int(beams))


def _print(what: str, took: np.ndarray, cpu: float) -> None:
    p50, p99, most = 1e3 * np.percentile(took, [50, 99, 100])
    print(f"{what:50}{p50:10.2f}{p99:10.2f}{most:10.2f}{cpu:14.3f}", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])

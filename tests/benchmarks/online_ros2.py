"""The node beside a robot on real ROS 2 (rclpy, Fast DDS): latency, processor, and service after restarts and kills.

`python -m tests.benchmarks.online_ros2 [kilted|jazzy] [RESTARTS] [KILLS]`; environments are made as for `make test-ros2`.
"""

from __future__ import annotations

import itertools
import os
import signal
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from tests.ros2.environment import HERE, clean_environment, ros2_python
from tests.ros2.peers import Process, Robot, start_skidloc

_DRIVE_S, _SETTLED_S, _MAX_OUTAGE_S = 60.0, 5.0, 60.0
_CLOUD_BYTES = 4_000_000


def measure_latency(distro: str, domain: int, folder: Path) -> None:
    """One drive of a minute, with the echo node beside."""
    node = start_skidloc(domain, "--state", folder / "latency.state", "--node.wait-s", "1")
    echo = Process(
        [ros2_python(distro), HERE / "echo.py"],
        {**clean_environment(), "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"},
    )
    robot = Robot(distro, domain)
    try:
        echo.line("up")
        node.line("waiting for", timeout_s=300.0)
        robot.do(f"drive {_SETTLED_S}")
        robot.do("clear")
        cpu, begin = cpu_seconds(node.process.pid), time.monotonic()
        robot.do(f"drive {_DRIVE_S}", timeout_s=2 * _DRIVE_S)
        share = (cpu_seconds(node.process.pid) - cpu) / (time.monotonic() - begin)
        found = robot.report()
    finally:
        for process in (robot, node, echo):
            process.kill()
    rate_hz = 1e9 / np.median(np.diff(found["predicted"]))
    print(f"{distro}: odometry for {found['answered']} of {found['sent']} scans ({100 * found['answered'] / found['sent']:.1f} %)")
    print(f"{distro}: predicted odometry and transforms at {rate_hz:.1f} Hz, {100 * share:.1f} % of a core")
    for name, latencies in (("skidloc", found["latencies_s"]), ("echo node", found["echo_latencies_s"])):
        p50, p99, most = 1e3 * np.quantile(latencies, [0.5, 0.99, 1.0])
        print(f"{distro}: {name}: scan sent to odometry received p50 {p50:.1f}, p99 {p99:.1f}, max {most:.1f} ms", flush=True)


def measure_stop(distro: str, domain: int, folder: Path) -> None:
    """SIGSTOP of 5 s in a drive: seconds until the first estimate of a scan that was sent after it."""
    node, robot = start_skidloc(domain, "--state", folder / "stop.state", "--node.wait-s", "1"), Robot(distro, domain)
    try:
        await_service(robot)
        robot.begin("drive 20")
        time.sleep(8.0)
        node.process.send_signal(signal.SIGSTOP)
        time.sleep(5.0)
        node.process.send_signal(signal.SIGCONT)
        resumed_s = time.monotonic()
        robot.line("done")
        after = min(sent_s + latency for sent_s, latency in robot.report()["answers_s"] if sent_s > resumed_s) - resumed_s
        print(f"{distro}: stopped for 5 s: first estimate of a scan sent after it {after:.2f} s after it", flush=True)
    finally:
        robot.kill()
        node.kill()


def measure_outages(distro: str, domain: int, folder: Path, restarts: int, kills: int) -> None:
    """Restarts in order and kills of robot and node in turn: seconds of the robot's drive until odometry comes again."""
    options = ("--state", folder / "outages.state", "--node.wait-s", "1")
    node, robot = start_skidloc(domain, *options), Robot(distro, domain)
    outages: dict[str, list[float]] = {}
    jobs = [(f"restart of {who}", signal.SIGINT) for who, _ in zip(itertools.cycle(("robot", "node")), range(restarts), strict=False)]
    jobs += [(f"kill of {who}", signal.SIGKILL) for who, _ in zip(itertools.cycle(("robot", "node")), range(kills), strict=False)]
    try:
        await_service(robot)
        for what, number in jobs:
            (robot if what.endswith("robot") else node).end(number)
            begin = time.monotonic()
            if what.endswith("robot"):
                robot = Robot(distro, domain)
            else:
                node = start_skidloc(domain, *options)
            await_service(robot)
            outages.setdefault(what, []).append(time.monotonic() - begin)
        node.end(signal.SIGINT)
    finally:
        robot.kill()
        node.kill()
    for what, seconds in outages.items():
        outage = f"odometry again after {np.median(seconds):.1f} s (at most {max(seconds):.1f} s)"
        print(f"{distro}: {len(seconds)} times {what}: {outage}", flush=True)
    print(f"{distro}: at the end the node {'ends in order' if node.process.returncode == 0 else node.text}")


def await_service(robot: Robot) -> None:
    """Drive until odometry comes. Raises `AssertionError` after a minute without."""
    end = time.monotonic() + _MAX_OUTAGE_S
    robot.do("clear")
    while robot.report()["answered"] == 0:
        assert time.monotonic() < end, "no odometry"
        robot.do("drive 0.5")


def measure_clouds(distro: str, domain: int) -> None:
    """Clouds of 4 MB at 10 Hz for 10 s, counted by the transport alone."""
    code = (
        "import sys, time\n"
        "from localization.ros.transports.dds import DdsTransport\n"
        "here, count, last = DdsTransport(int(sys.argv[1])), 0, time.monotonic() + 30\n"
        "here.subscribe('/points', 'sensor_msgs/msg/PointCloud2', is_latched=False)\n"
        "print('up', flush=True)\n"
        "while time.monotonic() < last:\n"
        "    for received in here.take(0.1):\n"
        "        count, last = count + (len(received.data) > int(sys.argv[2])), time.monotonic() + 3\n"
        "print('clouds', count, flush=True)\n"
    )
    receiver = Process([sys.executable, "-c", code, domain, _CLOUD_BYTES], {**clean_environment(), "PYTHONPATH": os.getcwd()})
    receiver.line("up")
    robot = Robot(distro, domain)
    robot.do(f"cloud {_CLOUD_BYTES} 100")
    print(f"{distro}: {receiver.line('clouds').split()[1]} of 100 clouds of 4 MB at 10 Hz", flush=True)
    robot.kill()


def cpu_seconds(pid: int) -> float:
    """User and system time of a process so far [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main(distro: str = "kilted", restarts: str = "10", kills: str = "20") -> None:
    domain = 100 + os.getpid() % 100
    print(f"{distro}: load of this machine {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores", flush=True)
    with tempfile.TemporaryDirectory() as name:
        measure_latency(distro, domain, Path(name))
        measure_stop(distro, domain + 3, Path(name))
        measure_clouds(distro, domain + 1)
        measure_outages(distro, domain + 2, Path(name), int(restarts), int(kills))


if __name__ == "__main__":
    main(*sys.argv[1:])

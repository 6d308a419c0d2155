"""Processes for the tests with real ROS 2 peers: a robot on rclpy, and skidloc."""

from __future__ import annotations

import contextlib
import functools
import json
import os
import pickle
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from localization.logs.reader import open_source
from tests.helpers.online import drive_log
from tests.ros2.environment import HERE, ROOT, clean_environment, ros2_python

_TOPICS = ("/joint_states", "/scan", "/imu/data", "/tf_static")
_FOLDER = tempfile.TemporaryDirectory(prefix="skidloc-ros2-")


@functools.cache
def messages_file() -> Path:
    """The drive of the other online tests as raw messages."""
    source = open_source(drive_log())
    kinds = {channel.topic: channel.type for channel in source.channels}
    messages = [(m.log_ns, m.topic, kinds[m.topic], bytes(m.data)) for m in source.messages([t for t in _TOPICS if t in kinds])]
    path = Path(_FOLDER.name) / "messages.pickle"
    path.write_bytes(pickle.dumps(messages))
    return path


class Process:
    """A process whose lines can be waited for."""

    def __init__(self, command, environment):
        options = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "cwd": ROOT}
        self.process = subprocess.Popen(list(map(str, command)), env={**environment, "PYTHONUNBUFFERED": "1"}, **options)
        self.lines, self._waiting = [], queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self):
        for line in self.process.stdout:
            self.lines.append(line.rstrip("\n"))
            self._waiting.put(self.lines[-1])

    @property
    def text(self):
        return " ".join(" ".join(self.lines).split())

    def line(self, wanted="", timeout_s=60.0):
        """The next line with ``wanted`` in it."""
        end = time.monotonic() + timeout_s
        while (left := end - time.monotonic()) > 0.0:
            with contextlib.suppress(queue.Empty):
                line = self._waiting.get(timeout=min(left, 0.5))
                if wanted in line:
                    return line
            if self.process.poll() is not None and self._waiting.empty():
                break
        raise AssertionError(f"no line with '{wanted}' within {timeout_s} s: {self.text}")

    def end(self, number=signal.SIGINT, timeout_s=30.0):
        """The exit code after signal ``number``."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        try:
            self.process.wait(timeout=timeout_s)
        except subprocess.TimeoutExpired as error:
            self.kill()
            raise AssertionError(f"does not end within {timeout_s} s of signal {number}: {self.text}") from error
        self._reader.join(timeout=5.0)
        return self.process.returncode

    def kill(self):
        self.process.kill()
        self.process.wait()


class Robot(Process):
    """`tests/ros2/robot.py` on ROS 2 ``distro``."""

    def __init__(self, distro, domain, **environment):
        super().__init__(
            [ros2_python(distro), HERE / "robot.py", messages_file()],
            {**clean_environment(), "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", **environment},
        )
        self.line("up")

    def do(self, command, timeout_s=60.0):
        self.begin(command)
        self.line("done", timeout_s)

    def begin(self, command):
        self.process.stdin.write(command + "\n")
        self.process.stdin.flush()

    def report(self):
        self.begin("report")
        return json.loads(self.line("{"))

    def leave(self):
        """As a driver that is stopped in order."""
        self.process.stdin.close()
        self.process.wait(timeout=20)


def start_skidloc(domain, *arguments, python=sys.executable, door="dds", **environment):
    """`skidloc online` on the topics of ``domain``."""
    command = [python, "-m", "localization.cli", "online", "--robot", "vaultbot", "--door", door, *arguments]
    return Process(command, {**clean_environment(), "PYTHONPATH": str(ROOT), "ROS_DOMAIN_ID": str(domain), **environment})


def own_domain(offset=0):
    """Not that of another run of these tests."""
    return 10 + (os.getpid() * 8 + offset) % 90

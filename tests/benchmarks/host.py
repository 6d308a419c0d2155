"""What this machine makes of work that comes in small pieces: the floor under every latency that is measured on it."""

from __future__ import annotations

import json
import os
import socket
import time

import numpy as np

_TRIES = 50


def paced(work_s: float, period_s: float, count: int) -> tuple[np.ndarray, float]:
    """Arithmetic that takes ``work_s`` when it is done over and over, done by a process that sleeps until a datagram comes, ``count`` of
    them and one every ``period_s``. Seconds from each datagram to the end of the work, and the part of a pipeline that it takes."""
    rounds = _rounds(work_s)
    ours, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    child = os.fork()
    if child == 0:
        took = []
        for _ in range(count):
            sent = float(its.recv(64))
            _work(rounds)
            took.append(time.monotonic() - sent)
        its.send(json.dumps([*took, time.process_time()]).encode())
        os._exit(0)
    begin = time.monotonic()
    for _ in range(count):
        time.sleep(period_s)
        ours.send(repr(time.monotonic()).encode())
    *took, cpu_s = json.loads(ours.recv(1 << 20))
    os.waitpid(child, 0)
    return np.array(took), cpu_s / (time.monotonic() - begin)


def _rounds(work_s: float) -> int:
    """How much `_work` takes ``work_s``, at the machine's best."""
    rounds = 10_000
    best = min(_seconds(rounds) for _ in range(_TRIES))
    return max(round(rounds * work_s / best), 1)


def _seconds(rounds: int) -> float:
    begin = time.perf_counter()
    _work(rounds)
    return time.perf_counter() - begin


def _work(rounds: int) -> int:
    total = 0
    for i in range(rounds):
        total += i * i
    return total

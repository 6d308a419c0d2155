"""Jobs on the processes of this machine. A process that dies takes its job with it and no other; the job is tried once more."""

from __future__ import annotations

import multiprocessing
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess

from localization.comparison.jobs import Job, Row, failed_rows, run_job

_TRIES = 2
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")

Work = Callable[[Job], list[Row]]


@dataclass
class _Worker:
    """A process, and the job that it has, the ``tries``-th time."""

    process: BaseProcess
    pipe: Connection
    job: Job
    tries: int


def run_local(jobs: Sequence[Job], processes: int, work: Work = run_job) -> Iterator[tuple[Job, list[Row]]]:
    """Each job with its rows, as it ends. ``work`` is run in the processes and must be importable there."""
    waiting = deque((job, 1) for job in jobs)
    context = multiprocessing.get_context("spawn")  # libraries with threads do not survive a fork
    busy: list[_Worker] = []
    try:
        while waiting or busy:
            while waiting and len(busy) < processes:
                busy.append(_start(context, work, *waiting.popleft()))
            ready = wait([worker.pipe for worker in busy])
            for worker in [worker for worker in busy if worker.pipe in ready]:
                job = worker.job
                try:
                    rows = worker.pipe.recv()
                except (EOFError, OSError):
                    busy.remove(worker)
                    worker.process.join()
                    if worker.tries < _TRIES:
                        waiting.append((job, worker.tries + 1))
                        continue
                    rows = failed_rows(job, f"its process died, {_cause(worker.process.exitcode)}, {_TRIES} times over.")
                else:
                    if waiting:
                        worker.job, worker.tries = waiting.popleft()
                        worker.pipe.send(worker.job)
                    else:
                        busy.remove(worker)
                        worker.pipe.close()  # by which the process ends
                yield job, rows
    finally:
        for worker in busy:
            worker.process.terminate()
            worker.process.join()


def _start(context: multiprocessing.context.SpawnContext, work: Work, job: Job, tries: int) -> _Worker:
    ours, theirs = context.Pipe()
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))  # one process, one core
    try:
        process = context.Process(target=_serve, args=(theirs, work), daemon=True)
        process.start()
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
    theirs.close()
    ours.send(job)
    return _Worker(process, ours, job, tries)


def _serve(pipe: Connection, work: Work) -> None:
    try:
        while True:
            pipe.send(work(pipe.recv()))
    except (EOFError, OSError, KeyboardInterrupt):  # the other side is done
        return


def _cause(code: int | None) -> str:
    return f"killed by signal {-code}" if code is not None and code < 0 else f"exit code {code}"

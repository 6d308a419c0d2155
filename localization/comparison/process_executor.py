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
    pool = _Pool(jobs, processes, work)
    try:
        yield from pool.results()
    finally:
        pool.terminate()


class _Pool:
    """Busy processes, and the jobs that wait for one, each with the number of its try."""

    def __init__(self, jobs: Sequence[Job], processes: int, work: Work) -> None:
        self._waiting = deque((job, 1) for job in jobs)
        self._context = multiprocessing.get_context("spawn")  # libraries with threads do not survive a fork
        self._busy: list[_Worker] = []
        self._processes, self._work = processes, work

    def results(self) -> Iterator[tuple[Job, list[Row]]]:
        """Each job with its rows, as it ends."""
        while self.fill():
            for worker in self.ready():
                job, rows = worker.job, self.receive(worker)
                if rows is not None:
                    yield job, rows

    def fill(self) -> bool:
        """Start processes for waiting jobs; whether any process is busy."""
        while self._waiting and len(self._busy) < self._processes:
            self._busy.append(_start(self._context, self._work, *self._waiting.popleft()))
        return bool(self._busy)

    def ready(self) -> list[_Worker]:
        """Processes that have ended their job or died; waits for one."""
        pipes = wait([worker.pipe for worker in self._busy])
        return [worker for worker in self._busy if worker.pipe in pipes]

    def receive(self, worker: _Worker) -> list[Row] | None:
        """Rows of the worker's job, and its next job; None where the process died and the job is tried again."""
        try:
            rows: list[Row] = worker.pipe.recv()
        except (EOFError, OSError):
            return self._replace(worker)
        if self._waiting:
            worker.job, worker.tries = self._waiting.popleft()
            worker.pipe.send(worker.job)
        else:
            self._busy.remove(worker)
            worker.pipe.close()  # by which the process ends
        return rows

    def _replace(self, worker: _Worker) -> list[Row] | None:
        self._busy.remove(worker)
        worker.process.join()
        if worker.tries < _TRIES:
            self._waiting.append((worker.job, worker.tries + 1))
            return None
        return failed_rows(worker.job, f"its process died, {_cause(worker.process.exitcode)}, {_TRIES} times over.")

    def terminate(self) -> None:
        for worker in self._busy:
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

"""Jobs of a comparison on executors of `concurrent.futures`: processes of this machine, or an existing Dask cluster (extra `dask`)."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import re
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.process import BaseProcess
from typing import Any, NamedTuple

from localization.comparison.jobs import Job, Row, failed_rows, run_job
from localization.errors import TransportError

CONNECT_TIMEOUT_S = 10.0
"""For a Dask scheduler and its first worker to answer."""
_TRIES = 2
_POLL_S = 5.0  # after which a lost connection is noticed at the latest
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
_ADDRESS = re.compile(r"((tcp|tls|wss?|ucxx?)://)?(\[[^\]]+\]|[^/:\[\]\s]+):\d+")

Work = Callable[[Job], list[Row]]


def run_jobs(
    jobs: Sequence[Job], executor: Executor, work: Work = run_job, is_lost: Callable[[], bool] = lambda: False
) -> Iterator[tuple[Job, list[Row]]]:
    """Each job with its rows, as it ends. Raises `CancelledError` where the executor cancels a job or ``is_lost``."""
    waiting = {executor.submit(work, job): job for job in jobs}
    while waiting:
        ended, _ = wait(waiting, _POLL_S, FIRST_COMPLETED)
        if not ended and is_lost():
            raise CancelledError("the connection was lost")
        for future in ended:
            job = waiting.pop(future)
            yield job, _rows(future, job)


def _rows(future: Future[list[Row]], job: Job) -> list[Row]:
    """Rows of a future that has ended; an error of its process or worker becomes rows with that error."""
    error = future.exception()
    return future.result() if error is None else failed_rows(job, _describe(error))


def _describe(error: BaseException) -> str:
    return str(error) if isinstance(error, BrokenProcessPool) else " ".join(f"{type(error).__name__}: {error}".split())[:200]


# Processes of this machine


def run_local(jobs: Sequence[Job], processes: int, work: Work = run_job) -> Iterator[tuple[Job, list[Row]]]:
    """`run_jobs` on so many processes, in which ``work`` must be importable."""
    with ProcessExecutor(processes) as executor:
        yield from run_jobs(jobs, executor, work)


class _Worker(NamedTuple):
    """A pool of one process, and that process; None where it died at its start."""

    pool: ProcessPoolExecutor
    process: BaseProcess | None

    def terminate(self) -> None:
        """End the process."""
        if self.process is not None:
            self.process.terminate()

    def end(self) -> str:
        """How the process ended, once its call has failed."""
        self.pool.shutdown()  # waits until the exit code is there
        code = None if self.process is None else self.process.exitcode
        return f"killed by signal {-code}" if code is not None and code < 0 else f"exit code {code}"


class ProcessExecutor(ThreadPoolExecutor):
    """A pool of processes in which one that dies loses only its own call, which is tried once more.

    In a `ProcessPoolExecutor` all calls fail where one process dies. Here each thread has such a pool of one process, and a new one after
    that has died. Used as a context manager that is left by an exception, it terminates all processes.
    """

    def __init__(self, processes: int) -> None:
        super().__init__(processes)
        self._of_thread = threading.local()
        self._workers: list[_Worker] = []
        self._lock = threading.Lock()
        self._is_terminated = False

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run ``fn(*args, **kwargs)`` in a process. Its future raises `BrokenProcessPool` where the process dies, twice."""
        return super().submit(self._call, fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Wait for all calls; ``cancel_futures``: drop those that wait, and terminate the processes of the others."""
        if cancel_futures:
            with self._lock:
                self._is_terminated = True
                for worker in self._workers:
                    worker.terminate()
        super().shutdown(wait, cancel_futures=cancel_futures)
        for worker in self._workers:
            worker.pool.shutdown(wait)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.shutdown(cancel_futures=kind is not None)

    def _call(self, fn: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """In a thread: ``fn`` in this thread's process."""
        for _ in range(_TRIES):
            worker = getattr(self._of_thread, "worker", None) or self._start_worker()
            self._of_thread.worker = worker
            try:
                return worker.pool.submit(fn, *args, **kwargs).result()
            except BrokenProcessPool:
                self._of_thread.worker = None
                cause = worker.end()
                if self._is_terminated:
                    raise
        raise BrokenProcessPool(f"its process died, {cause}, {_TRIES} times over.")

    def _start_worker(self) -> _Worker:
        # libraries with threads do not survive a fork
        pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), initializer=_prepare_process)
        with self._lock:
            before = {name: os.environ.get(name) for name in _ONE_THREAD}
            os.environ.update(_ONE_THREAD)  # one process, one core
            try:
                started = pool.submit(os.getpid)
            finally:
                for name, value in before.items():
                    os.environ.pop(name) if value is None else os.environ.update({name: value})
        process = None
        with contextlib.suppress(BrokenProcessPool):
            pid = started.result()
            process = next((child for child in multiprocessing.active_children() if child.pid == pid), None)
        worker = _Worker(pool, process)
        with self._lock:
            self._workers.append(worker)
            if self._is_terminated:
                worker.terminate()
        return worker


def _prepare_process() -> None:
    """Ignore Ctrl-C, which goes to all processes of a terminal, and end with the parent, however that ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_exit_with_parent, daemon=True).start()


def _exit_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


# A Dask cluster. Its workers need this library, and the logs under the same paths.


def run_on_cluster(jobs: Sequence[Job], address: str) -> Iterator[tuple[Job, list[Row]]]:
    """`run_jobs` on the cluster of the scheduler at ``address``. Jobs of a lost worker run again on another. Raises `TransportError`."""
    try:
        import distributed
    except ImportError as error:
        raise TransportError(f"a Dask cluster needs the extra 'dask': pip install 'skidloc[dask]' ({error}).") from error
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # it logs tracebacks for a lost scheduler; here it is one sentence
    if not _ADDRESS.fullmatch(address):  # distributed would retry until its timeout, then raise a traceback
        raise TransportError(f"'{address}' is not an address of a Dask scheduler; an example is tcp://host:8786.")
    try:
        client = distributed.Client(address, timeout=CONNECT_TIMEOUT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise TransportError(
            f"no Dask scheduler answers at {address} ({_describe(error)}). Start `dask scheduler` there, or leave --dask out."
        ) from error
    try:
        if not client.scheduler_info()["workers"]:
            try:
                client.wait_for_workers(1, timeout=CONNECT_TIMEOUT_S)
            except TimeoutError as error:
                raise TransportError(f"the Dask scheduler at {address} has no workers. Start some: dask worker {address}.") from error
        yield from run_jobs(jobs, client.get_executor(pure=False, retries=1), is_lost=lambda: client.status != "running")
    except (OSError, distributed.client.ClosedClientError, CancelledError) as error:
        raise TransportError(
            f"the Dask scheduler at {address} went away ({_describe(error)}). What was done is kept: run the same again."
        ) from error
    finally:
        client.close(timeout=CONNECT_TIMEOUT_S)

"""Jobs on an existing Dask cluster (extra `dask`). Its workers need this library, and the logs under the same paths."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Sequence

from localization.comparison.jobs import Job, Row, failed_rows, run_job
from localization.errors import TransportError

try:
    import distributed
except ImportError as error:
    raise TransportError(f"a Dask cluster needs the extra 'dask': pip install 'skidloc[dask]' ({error}).") from error

logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # it logs tracebacks for a lost scheduler; here it is one sentence

_TIMEOUT_S = 10
_ADDRESS = re.compile(r"((tcp|tls|wss?|ucxx?)://)?(\[[^\]]+\]|[^/:\[\]\s]+):\d+")


def run_on_cluster(jobs: Sequence[Job], address: str) -> Iterator[tuple[Job, list[Row]]]:
    """Each job with its rows, as it ends. What a lost worker had is done by another. Raises `TransportError`."""
    if not _ADDRESS.fullmatch(address):  # distributed would retry until its timeout, then raise a traceback
        raise TransportError(f"'{address}' is not an address of a Dask scheduler; an example is tcp://host:8786.")
    try:
        client = distributed.Client(address, timeout=_TIMEOUT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise TransportError(
            f"no Dask scheduler answers at {address} ({_short(error)}). Start `dask scheduler` there, or leave --dask out."
        ) from error
    try:
        if not client.scheduler_info()["workers"]:
            try:
                client.wait_for_workers(1, timeout=_TIMEOUT_S)
            except TimeoutError as error:
                raise TransportError(f"the Dask scheduler at {address} has no workers. Start some: dask worker {address}.") from error
        futures = {client.submit(run_job, job, pure=False, retries=1): job for job in jobs}
        for future in distributed.as_completed(list(futures), loop=client.loop):
            job = futures.pop(future)
            yield job, _rows(future, job)
            future.release()
    except (OSError, distributed.client.ClosedClientError, distributed.client.FutureCancelledError) as error:
        raise TransportError(
            f"the Dask scheduler at {address} went away ({_short(error)}). What was done is kept: run the same again."
        ) from error
    finally:
        client.close(timeout=_TIMEOUT_S)


def _rows(future: distributed.Future, job: Job) -> list[Row]:
    """Rows of a future that has ended. Raises errors of the cluster; errors of the job alone become rows."""
    try:
        rows: list[Row] = future.result()
    except Exception as error:
        if future.status != "error":
            raise
        return failed_rows(job, f"on the cluster: {_short(error)}")
    return rows


def _short(error: Exception) -> str:
    if isinstance(error, distributed.client.FutureCancelledError):
        return str(error.reason)
    return " ".join(f"{type(error).__name__}: {error}".split())[:200]

"""Calls that a process of the lowest priority answers, one after the other: beside it a node keeps its processor and its interpreter."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future, InvalidStateError
from contextlib import suppress
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

_LOWEST_PRIORITY = 19
_IDLE_S = 60.0
"""Time without a call after which the process ends, and its memory with it; the next call starts another one [s]."""


class QuietProcess(Executor):
    """`submit` calls whose function and arguments can be pickled. The process starts with a call, and ends by `shutdown`, or where none
    comes for a minute."""

    def __init__(self) -> None:
        self._process: BaseProcess | None = None
        self._calls: Connection | None = None
        self._turn = threading.Lock()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """The result of ``fn`` of the arguments, once the process has it; of a process that has ended the future is cancelled."""
        future: Future[Any] = Future()
        threading.Thread(target=self._answer, args=(future, fn, args, kwargs), name="quiet process", daemon=True).start()
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the process at once; what it has not answered is cancelled."""
        if self._process is not None:
            self._process.terminate()

    def _answer(self, future: Future[Any], fn: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        with self._turn:
            try:
                calls = self._running()
                calls.send((fn, args, kwargs))
                is_done, result = calls.recv()
            except (EOFError, OSError):
                future.cancel()
                return
        with suppress(InvalidStateError):
            future.set_result(result) if is_done else future.set_exception(result)

    def _running(self) -> Connection:
        """The connection to the process, which is started where none is there."""
        if self._calls is not None and self._process is not None and self._process.is_alive():
            return self._calls
        context = multiprocessing.get_context("spawn")
        here, there = context.Pipe()
        self._process = context.Process(target=_serve, args=(there,), name="skidloc-set-up", daemon=True)
        self._process.start()
        there.close()
        self._calls = here
        return here


def _serve(calls: Connection) -> None:
    os.nice(_LOWEST_PRIORITY)
    with suppress(EOFError, OSError):  # the node has ended
        while calls.poll(_IDLE_S):
            fn, args, kwargs = calls.recv()
            try:
                answer = True, fn(*args, **kwargs)
            except Exception as error:  # raised again where the answer is taken
                answer = False, error
            calls.send(answer)

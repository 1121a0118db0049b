"""Worker processes that end with the run, however it ends: at once, and without a word of their own."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from threading import Thread, current_thread, main_thread

from endotwin.errors import OutputError

STOPPING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGALRM") if hasattr(signal, name))
"""Signals that end a command: the last is its second try, which Windows does without."""

TUNABLES, LARGE_PAGES = "GLIBC_TUNABLES", "glibc.malloc.hugetlb=1"
"""What glibc's malloc heeds from its start on."""


class Pool(ProcessPoolExecutor):
    """So many spawned ``workers``, which Ctrl-C does not reach, each begun by ``begin(*arguments)``.

    A block that an error leaves kills them, whatever they are at. They end with this process too, even where
    that is killed. A script that makes one needs ``if __name__ == "__main__":``.

    Raises:
        OutputError: at the end of the block, where a process died.
    """

    def __init__(self, workers: int, begin: Callable | None = None, *arguments: object) -> None:
        self.workers = workers
        super().__init__(workers, multiprocessing.get_context("spawn"), _enlist, (begin, arguments))

    def submit(self, function: Callable, /, *arguments: object) -> Future:
        with _held_back(*STOPPING), _large_pages():  # the first calls start the processes
            return super().submit(function, *arguments)

    def __exit__(self, kind: type | None, error: BaseException | None, trace: object) -> None:
        if kind is not None:
            for process in list((self._processes or {}).values()):  # there is no public way before 3.14
                process.kill()
        super().__exit__(kind, error, trace)
        if isinstance(error, BrokenProcessPool):
            raise OutputError(
                "a worker process died, perhaps for want of memory; try fewer workers"
            ) from error


@contextmanager
def _held_back(*numbers: int) -> Iterator[None]:
    """The signals wait until the block has ended; Ctrl-C never reaches a process that is started within.

    The mask, which such a process inherits, holds this thread alone: any other takes the signal, and Python
    then calls its handler in the main thread, in the midst of the block. Windows has no mask.
    """
    masked = hasattr(signal, "pthread_sigmask")
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if masked else None
    came: list[int] = []
    within_main = current_thread() is main_thread()
    handlers = {n: signal.signal(n, lambda number, _: came.append(number)) for n in numbers if within_main}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        if masked:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for number in came[:1]:
            signal.raise_signal(number)


@contextmanager
def _large_pages() -> Iterator[None]:
    """Processes that are started within ask the system for large pages of memory, where it is Linux with
    glibc: a frame of a dataset takes a twentieth less time."""
    before = os.environ.get(TUNABLES)
    os.environ[TUNABLES] = f"{before}:{LARGE_PAGES}" if before else LARGE_PAGES
    try:
        yield
    finally:
        if before is None:
            del os.environ[TUNABLES]
        else:
            os.environ[TUNABLES] = before


def _enlist(begin: Callable | None, arguments: tuple) -> None:
    """Make this process a worker."""
    Thread(target=_end_with_parent, daemon=True).start()
    if begin:
        begin(*arguments)


def _end_with_parent() -> None:
    multiprocessing.parent_process().join()
    os._exit(1)

"""Long jobs at the same time, that are counted as one and stop as one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor, as_completed
from contextlib import nullcontext
from threading import Event, Lock
from typing import TypeVar

from endotwin.run.threads import one_core

Job = TypeVar("Job")


def together(
    work: Callable[[Job, Callable[[int], None]], None],
    jobs: Sequence[Job],
    threads: int,
    progress: Callable[[int], None],
) -> None:
    """``work(job, count)`` for all ``jobs``, so many at a time on one core each; a last one that would be
    alone follows on all cores.

    The first error, or Ctrl-C, stops the others at their next ``count``.

    Args:
        work: calls ``count`` with how much of the job is done.
        progress: called with how much of all jobs is done, by one job at a time.
    """
    alone = len(jobs) % threads == 1
    done, stopped, turn = [0] * len(jobs), Event(), Lock()

    def begin(number: int) -> None:
        def count(amount: int) -> None:
            if stopped.is_set():
                raise CancelledError
            with turn:
                done[number] = amount
                progress(sum(done))

        work(jobs[number], count)

    with one_core() if threads > 1 else nullcontext(), ThreadPoolExecutor(threads) as pool:
        try:
            for job in as_completed([pool.submit(begin, number) for number in range(len(jobs) - alone)]):
                job.result()
        except BaseException:
            stopped.set()
            pool.shutdown(cancel_futures=True)
            raise
    if alone:
        begin(len(jobs) - 1)  # in this thread: torch is slower on all cores from another

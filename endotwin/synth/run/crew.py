"""Who renders the shards: this process, several of them, or a Dask cluster. The bytes do not depend on it."""

from __future__ import annotations

import logging
import pickle
from collections.abc import Collection, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Self

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from endotwin.errors import OptionError, OutputError
from endotwin.run.processes import Pool
from endotwin.run.threads import cores, one_core
from endotwin.synth.job import Job
from endotwin.synth.labels import Labeller
from endotwin.synth.run.shard import DONE, render_shard

WORTH_PROCESSES = 2e7
"""Pixels, of all frames, below which starting processes takes longer than it saves: 65 VGA frames."""

SCHEDULER_TIMEOUT_S = 15


def render_here(job: Job, folder: Path, shards: Iterable[int]) -> Iterator[int]:
    """Render in this process, one shard after the other."""
    with one_core():
        labeller = Labeller(job)
        for number in shards:
            render_shard(job, labeller, folder, number)
            yield number


class Crew:
    """Worker processes: so many, or, for 0, as many as there are cores, where it is worth it. They start, and
    load what they need, as soon as it is ``expected`` how much there is to render, while this process still
    prepares the job. They end with the block."""

    def __init__(self, workers: int):
        self._workers = workers
        self._called = ExitStack()
        self.pool: Pool | None = None

    def expected(self, pixels: int) -> None:
        """So many pixels, of all frames, are to be rendered."""
        workers = enough(self._workers, pixels)
        if workers > 1:
            self.pool = self._called.enter_context(Pool(workers))
            for _ in range(workers):
                self.pool.submit(_keep_to_one_core)  # and so load this module

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> bool | None:
        return self._called.__exit__(*error)


def enough(workers: int, pixels: int) -> int:
    """How many processes so many pixels are worth, where 0 are asked for."""
    return workers or (cores() if pixels >= WORTH_PROCESSES else 1)


def render_in_processes(job: Job, folder: Path, shards: Iterable[int], pool: Pool) -> Iterator[int]:
    """Render in the processes of ``pool``, each of which reads the job once; the shards' numbers as they
    come."""
    sent = folder / DONE / "job.pickle"
    with sent.open("wb") as file:
        pickle.dump(job, file, pickle.HIGHEST_PROTOCOL)
    left = sorted(shards)
    with pool:
        tasks: dict[Future, int] = {}

        def hand_out(after: int | None = None) -> None:
            number = next_shard(left, after, tasks.values())
            left.remove(number)
            tasks[pool.submit(_work, sent, folder, number)] = number

        for _ in range(min(pool.workers, len(left))):
            hand_out()
        while tasks:
            for task in wait(tasks, return_when=FIRST_COMPLETED).done:
                number = tasks.pop(task)
                task.result()
                if left:
                    hand_out(number)
                yield number


def next_shard(left: Sequence[int], after: int | None, at_work: Collection[int]) -> int:
    """Which of the shards that are ``left``, ascending, the worker that did ``after`` does next: the one that
    follows, whose first frames see what it has kept; else, of the longest run, the first, or the one in the
    middle where a worker is coming from the front."""
    if after is not None and after + 1 in left:
        return after + 1
    run = max(np.split(left, np.flatnonzero(np.diff(left) != 1) + 1), key=len)
    return int(run[len(run) // 2] if run[0] - 1 in at_work else run[0])


def render_on_cluster(job: Job, folder: Path, shards: Iterable[int], scheduler: str) -> Iterator[int]:
    """Render on the workers of a Dask scheduler, which must see ``folder`` too; their numbers as they come.

    Raises:
        OptionError: Dask is not installed, no scheduler answers, or its workers write elsewhere.
    """
    try:
        from distributed import Client, KilledWorker, as_completed
        from distributed.comm import resolve_address
    except ImportError as error:
        raise OptionError(
            "a scheduler needs Dask; install it with pip install 'endotwin[cluster]'"
        ) from error
    try:
        resolve_address(scheduler)
        client = Client(scheduler, timeout=SCHEDULER_TIMEOUT_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise OptionError(f"no Dask scheduler answers at {scheduler!r}; check the address") from error
    with _silent("distributed"), client, client.as_current():
        if not client.scheduler_info(n_workers=-1)["workers"]:
            raise OptionError(
                f"the Dask scheduler at {scheduler} has no workers; start some with 'dask worker'"
            )
        sent = client.scatter(job, broadcast=True, hash=False)
        tasks = [client.submit(_work_for, sent, folder.absolute(), number, pure=False) for number in shards]
        try:
            for task in as_completed(tasks):
                number = task.result()
                if not (folder / DONE / f"{number:06d}.json").is_file():
                    raise OptionError(
                        f"the workers of {scheduler} do not write to {folder.absolute()}; put the dataset "
                        f"on a disk "
                        "that they share"
                    )
                yield number
                task.release()
        except (CancelledError, KilledWorker) as error:
            raise OutputError(
                f"the Dask scheduler at {scheduler} or its workers were lost; start them again"
            ) from error
        finally:
            client.cancel(tasks)


@contextmanager
def _silent(library: str) -> Iterator[None]:
    """What goes wrong in the block is told by our own errors, not by the library's log as well."""
    names = [name for name in logging.root.manager.loggerDict if name.partition(".")[0] == library]
    loud = [logger for logger in map(logging.getLogger, names) if not logger.disabled]
    for logger in loud:
        logger.disabled = True
    try:
        yield
    finally:
        for logger in loud:
            logger.disabled = False


# In the worker

_bench: tuple[Job, Labeller] | None = None
_building = Lock()


def _work(sent: Path, folder: Path, number: int) -> None:
    """Render a shard of the job in the file ``sent``, the only one of this process."""
    global _bench
    if _bench is None:
        _keep_to_one_core()
        job = pickle.loads(sent.read_bytes())
        _bench = (job, Labeller(job))
    render_shard(*_bench, folder, number)


def _work_for(job: Job, folder: Path, number: int) -> int:
    """Render a shard in a Dask worker, which keeps the labeller of its latest job."""
    global _bench
    with _building:
        if _bench is None or _bench[0] is not job:
            _keep_to_one_core()
            _bench = (job, Labeller(job))
        labeller = _bench[1]
    render_shard(job, labeller, folder, number)
    return number


@cache
def _keep_to_one_core() -> None:
    """Torch and BLAS keep to the calling thread: with threads of their own, a frame takes 4 times as long."""
    torch.set_num_threads(1)
    threadpool_limits(1, user_api="blas")

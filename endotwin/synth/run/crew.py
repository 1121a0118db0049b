"""Who renders the shards: this process, several of them, or a Dask cluster. The bytes do not depend on it."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from threading import Lock, Thread

import torch
from threadpoolctl import threadpool_limits

from endotwin.errors import OptionError, OutputError
from endotwin.synth.job import Job
from endotwin.synth.labels import Labeller
from endotwin.synth.run.shard import DONE, render_shard

SCHEDULER_TIMEOUT_S = 15


def render_here(job: Job, folder: Path, shards: Iterable[int]) -> Iterator[int]:
    """Render in this process, one shard after the other."""
    with _one_core():
        labeller = Labeller(job)
        for number in shards:
            render_shard(job, labeller, folder, number)
            yield number


def render_in_processes(job: Job, folder: Path, shards: Iterable[int], workers: int) -> Iterator[int]:
    """Render in so many processes, each of which reads the job once; the shards' numbers as they come.

    The processes are spawned, so a script that calls this needs ``if __name__ == "__main__":``. They end with
    this process, even where it is killed.
    """
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    sent = folder / DONE / "job.pickle"
    with sent.open("wb") as file:
        pickle.dump(job, file, pickle.HIGHEST_PROTOCOL)
    with ProcessPoolExecutor(workers, context, _enlist, (sent, folder, stop)) as pool:
        try:
            tasks = {pool.submit(_work, number): number for number in shards}
            while tasks:
                for task in wait(tasks, return_when=FIRST_COMPLETED).done:
                    task.result()
                    yield tasks.pop(task)
        except BrokenProcessPool as error:
            raise OutputError(
                "a worker process died, perhaps for want of memory; the same command goes on with fewer "
                "--workers"
            ) from error
        finally:
            stop.set()
            pool.shutdown(wait=True, cancel_futures=True)


def render_on_cluster(job: Job, folder: Path, shards: Iterable[int], scheduler: str) -> Iterator[int]:
    """Render on the workers of a Dask scheduler, which must see ``folder`` too; their numbers as they come.

    Raises:
        OptionError: Dask is not installed, no scheduler answers, or its workers write elsewhere.
    """
    try:
        from distributed import Client, as_completed
    except ImportError as error:
        raise OptionError(
            "--scheduler needs Dask; install it with pip install 'endotwin[cluster]'"
        ) from error
    try:
        client = Client(scheduler, timeout=SCHEDULER_TIMEOUT_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise OptionError(f"no Dask scheduler answers at {scheduler!r}; check the address") from error
    with client, client.as_current():
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
        finally:
            client.cancel(tasks)


# In the worker

_bench: tuple[Job, Labeller, Path, object] | None = None
_building = Lock()


def _enlist(sent: Path, folder: Path, stop: object) -> None:
    """Make this process a worker for the job in the file ``sent``."""
    global _bench
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    Thread(target=_end_with_parent, daemon=True).start()
    _keep_to_one_core()
    job = pickle.loads(sent.read_bytes())
    _bench = (job, Labeller(job), folder, stop)


def _end_with_parent() -> None:
    multiprocessing.parent_process().join()
    os._exit(1)


def _work(number: int) -> None:
    job, labeller, folder, stop = _bench
    render_shard(job, labeller, folder, number, stop.is_set)


def _work_for(job: Job, folder: Path, number: int) -> int:
    """Render a shard in a Dask worker, which keeps the labeller of its latest job."""
    global _bench
    with _building:
        if _bench is None or _bench[0] is not job:
            _keep_to_one_core()
            _bench = (job, Labeller(job), folder, None)
        labeller = _bench[1]
    render_shard(job, labeller, folder, number)
    return number


@cache
def _keep_to_one_core() -> None:
    """Torch and BLAS keep to the calling thread: with threads of their own, a frame takes 4 times as long."""
    torch.set_num_threads(1)
    threadpool_limits(1, user_api="blas")


@contextmanager
def _one_core() -> Iterator[None]:
    """``_keep_to_one_core`` for the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1, user_api="blas"):
            yield
    finally:
        torch.set_num_threads(before)

"""Work that is done ahead of its use, a few items at a time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from endotwin.run.threads import THREADS, one_core

Item = TypeVar("Item")
Made = TypeVar("Made")


def ahead(make: Callable[[Item], Made], items: Iterable[Item], threads: int = 1) -> Iterator[Made]:
    """``map(make, items)`` in order, with ``threads`` of the next results being made while one is used."""
    with ThreadPoolExecutor(threads) as pool:
        pending: deque = deque()
        for item in items:
            pending.append(pool.submit(make, item))
            if len(pending) > threads:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()


def on_all_cores(make: Callable[[Item], Made], items: Iterable[Item]) -> Iterator[Made]:
    """``map(make, items)`` in order, an item on each core at a time: what torch and NumPy do to a few hundred
    thousand numbers they mostly do on one."""
    with one_core():
        yield from ahead(make, items, THREADS)

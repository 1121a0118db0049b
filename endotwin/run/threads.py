"""How many threads work is spread over, and on which device."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING

from endotwin.errors import OptionError

if TYPE_CHECKING:
    import torch
    from threadpoolctl import ThreadpoolController

DEVICES = ("cpu", "cuda", "auto")

MOST_THREADS = 8
"""Of readers and ray casters: each holds a frame or two, and more would wait for each other's memory."""


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _threads() -> int:
    """As many as there are cores, but no more than OMP_NUM_THREADS, which torch and BLAS heed too."""
    wanted = os.environ.get("OMP_NUM_THREADS", "").split(",")[0].strip()
    return max(1, min(cores(), MOST_THREADS, int(wanted) if wanted.isdecimal() else MOST_THREADS))


THREADS = _threads()
"""Of readers and ray casters. No result depends on it: what they make is used in order."""


def device_of(name: str) -> torch.device:
    """The device ``cpu``, ``cuda``, or for ``auto`` a GPU if there is one. Raises OptionError where there is
    none."""
    import torch

    if name not in DEVICES:
        raise OptionError(f"there is no device '{name}'; choose one of: {', '.join(DEVICES)}")
    there = torch.cuda.is_available()
    if name == "cuda" and not there:
        raise OptionError("torch finds no GPU here; install its CUDA build, or choose the device cpu")
    return torch.device("cuda" if there and name != "cpu" else "cpu")


@cache
def _blas() -> ThreadpoolController:
    """The BLAS of NumPy and that of SciPy, looked for once: that takes as long as some of the work."""
    import scipy.linalg  # noqa: F401, which loads its own
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController().select(user_api="blas")


@contextmanager
def one_core() -> Iterator[None]:
    """Torch and BLAS keep to the calling thread, and to each that is started in the block: small work takes
    four times as long where they have threads of their own."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with _blas().limit(limits=1):
            yield
    finally:
        torch.set_num_threads(before)

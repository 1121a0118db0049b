"""Locks of folders and files between runs. Windows has none of folders: there nobody waits for another."""

from __future__ import annotations

import os
from pathlib import Path

try:
    import fcntl
except ImportError:
    fcntl = None

EXIST = fcntl is not None


def take(place: Path, wait: bool = True) -> int | None:
    """A descriptor of a file or folder that holds its lock until it is released; None where there are none.

    Raises OSError where another run holds it and ``wait`` is false, or where the file system has no locks and
    it would not be told.
    """
    if fcntl is None:
        return None
    descriptor = os.open(place, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError:
        if not wait:
            os.close(descriptor)
            raise
    return descriptor


def release(descriptor: int | None) -> None:
    """Give back what ``take`` gave."""
    if descriptor is not None:
        os.close(descriptor)

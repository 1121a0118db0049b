"""Faults of the file system: at a chosen operation the process dies, or the disk is full."""

from __future__ import annotations

import builtins
import errno
import io
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from endotwin.run import locks

KILLED = 9
OPERATIONS = ("rename", "replace", "link", "mkdir", "rmdir", "unlink", "fsync")


class _Torn:
    """A file opened for writing, half of whose every write is done when the fault may strike."""

    def __init__(self, file: io.IOBase, strike: Callable[[str, object], None]) -> None:
        self._file, self._strike = file, strike

    def write(self, content) -> int:
        half = len(content) // 2
        self._file.write(content[:half])
        self._strike("write", self._file.name)
        return half + self._file.write(content[half:])

    def __getattr__(self, name: str):
        return getattr(self._file, name)

    def __enter__(self):
        self._file.__enter__()
        return self

    def __exit__(self, *error) -> None:
        self._file.__exit__(*error)


@contextmanager
def faults(strike: Callable[[str, object], None]) -> Iterator[None]:
    """``strike(operation, path or descriptor)`` is called before each operation on the file system that
    changes it, and may raise or end the process."""

    def struck(name: str, original: Callable) -> Callable:
        def operation(path, *rest, **named):
            strike(name, path)
            return original(path, *rest, **named)

        return operation

    opened = io.open

    def open_(file, mode="r", *rest, **named):
        if not set(mode) & set("wax+"):
            return opened(file, mode, *rest, **named)
        strike("open", file)
        return _Torn(opened(file, mode, *rest, **named), strike)

    with pytest.MonkeyPatch.context() as patch:
        for name in OPERATIONS:
            patch.setattr(os, name, struck(name, getattr(os, name)))
        patch.setattr(io, "open", open_)
        patch.setattr(builtins, "open", open_)
        yield


def killed_at_every_operation(work: Callable[[], None], look: Callable[[], None]) -> int:
    """Run ``work`` in processes of their own, the k-th of which dies at its k-th operation, and ``look`` at
    what each leaves, until one comes to its end; how many were killed."""
    for kill_at in range(1000):
        child = os.fork()
        if child == 0:
            _die_at(kill_at, work)
        _, status = os.waitpid(child, 0)
        code = os.waitstatus_to_exitcode(status)
        assert code in (0, KILLED)
        look()
        if code == 0:
            return kill_at
    raise AssertionError("the work never ends")


def _die_at(kill_at: int, work: Callable[[], None]) -> None:
    left = [kill_at]

    def strike(operation: str, path: object) -> None:
        left[0] -= 1
        if left[0] < 0:
            os._exit(KILLED)

    try:
        with faults(strike):
            work()
    except BaseException:
        os._exit(1)
    os._exit(0)


class Killed(BaseException):
    """The process is dead."""


@contextmanager
def killed(below: Path, after: int | None) -> Iterator[list[str]]:
    """From its operation number ``after`` (None: never) below a folder on, the process changes no file, as if
    it had been killed there: Killed is raised, its locks are let go. Gives the operations that it did.

    Unlike a process that dies, its threads and what libraries have loaded can be used again.
    """
    done: list[str] = []
    held: set[int] = set()
    take, release = locks.take, locks.release

    def taken(*arguments, **named) -> int:
        held.add(descriptor := take(*arguments, **named))
        return descriptor

    def released(descriptor: int) -> None:
        held.discard(descriptor)
        release(descriptor)

    def strike(operation: str, path: object) -> None:
        inside = isinstance(path, int) or str(Path(os.fsdecode(path)).absolute()).startswith(str(below))
        if inside and after is not None and len(done) >= after:
            raise Killed
        if inside:
            done.append(operation)

    with faults(strike), pytest.MonkeyPatch.context() as patch:
        patch.setattr(locks, "take", taken)
        patch.setattr(locks, "release", released)
        yield done
    for descriptor in held:
        os.close(descriptor)


@contextmanager
def full_disk(below: Path, after: int = 0) -> Iterator[None]:
    """No byte more can be written below a folder after so many operations that need room."""
    left = [after]

    def strike(operation: str, path: object) -> None:
        needs_room = operation in ("open", "write", "mkdir", "fsync")
        inside = isinstance(path, int) or str(Path(os.fsdecode(path)).absolute()).startswith(str(below))
        if needs_room and inside:
            left[0] -= 1
            if left[0] < 0:
                place = None if isinstance(path, int) else os.fsdecode(path)
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), place)

    with faults(strike):
        yield

"""Outputs are written whole or not at all: beside their place, then renamed into it."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from endotwin.errors import OutputError


def check_free(path: Path, overwrite: bool) -> None:
    """Raise OutputError if ``path`` exists and may not be overwritten, or if its folder cannot hold it."""
    path = Path(path)
    if path.exists() and not overwrite:
        raise OutputError(f"{path} exists already; choose another name or pass --overwrite")
    parent = path.absolute().parent
    existing = next(folder for folder in [parent, *parent.parents] if folder.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        raise OutputError(f"{path} cannot be written: {existing} is not a folder that you may write to")


@contextmanager
def _parents_made(path: Path) -> Iterator[None]:
    """The missing parents of ``path``, made for the block and unmade if it raises."""
    missing = [folder for folder in path.absolute().parents if not folder.exists()]
    path.absolute().parent.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        with suppress(OSError):  # not empty: someone else's by now
            for folder in missing:
                folder.rmdir()
        raise


@contextmanager
def whole_folder(path: Path, overwrite: bool = False) -> Iterator[Path]:
    """A new folder to fill, which becomes ``path`` when the block ends well and vanishes when it does not."""
    path = Path(path)
    check_free(path, overwrite)
    beside = path.absolute().with_name(f".{path.name}.{os.getpid()}.part")
    with _parents_made(beside):
        beside.mkdir()
        try:
            yield beside
            if path.exists():
                old = beside.with_suffix(".old")
                path.rename(old)
                beside.rename(path)
                shutil.rmtree(old) if old.is_dir() else old.unlink()
            else:
                beside.rename(path)
        except BaseException:
            shutil.rmtree(beside, ignore_errors=True)
            raise


@contextmanager
def whole_file(path: Path, overwrite: bool = False) -> Iterator[Path]:
    """A path to write to, which becomes ``path`` when the block ends well and vanishes when it does not."""
    path = Path(path)
    check_free(path, overwrite)
    beside = path.absolute().with_name(f".{os.getpid()}.part.{path.name}")
    with _parents_made(beside):
        try:
            yield beside
            beside.replace(path)
        except BaseException:
            beside.unlink(missing_ok=True)
            raise

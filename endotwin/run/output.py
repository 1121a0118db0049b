"""Outputs are written whole or not at all: beside their place, then moved into it.

Only what endotwin wrote is ever replaced: a folder is known by the file that marks its kind.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from endotwin.errors import OutputError

TWIN, DATASET, TRADEOFF = "twin.json", "dataset.json", "ladder.json"
"""Marks of the folders that endotwin writes."""


def check_free(path: Path, overwrite: bool, mark: str | None = None) -> None:
    """Raise OutputError if ``path`` exists and may not be overwritten, or if its folder cannot hold it.

    Args:
        mark: of a folder to be written, the file without which one that is there is not endotwin's to
            replace; None where ``path`` is to be a file.
    """
    path = Path(path)
    if path.exists():
        _check_own(path, mark)
        if not overwrite:
            raise OutputError(f"{path} exists already; choose another name or pass --overwrite")
    places = [path, *path.absolute().parents] if mark else path.absolute().parents
    existing = next(place for place in places if place.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        raise OutputError(f"{path} cannot be written: {existing} is not a folder that you may write to")


def check_picture(path: Path, overwrite: bool) -> None:
    """``check_free`` of a picture, which must be named as a PNG file."""
    if Path(path).suffix.lower() != ".png":
        raise OutputError(f"{path} is not the name of a PNG picture; let it end in .png")
    check_free(path, overwrite)


def check_apart(path: Path, inputs: Iterable[Path | str | None]) -> None:
    """Raise OutputError if one of ``inputs``, where it is a file or folder, is ``path`` or lies in it."""
    for source in filter(None, inputs):
        if os.path.exists(source) and Path(source).resolve().is_relative_to(Path(path).resolve()):
            raise OutputError(f"{path} cannot be replaced: {source} is read from it; choose another name")


def _check_own(path: Path, mark: str | None) -> None:
    if mark is None:
        if path.is_dir():
            raise OutputError(f"{path} is a folder; give the name of a file")
    elif not path.is_dir() or (any(path.iterdir()) and not (path / mark).is_file()):
        raise OutputError(
            f"{path} exists already and is not endotwin's to replace (it has no {mark}); choose another name"
        )


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
def whole_folder(path: Path, files: tuple[str, ...], overwrite: bool = False) -> Iterator[Path]:
    """A new folder to fill, which becomes ``path`` when the block ends well and vanishes when it does not.

    Of a folder that is there already, only ``files`` are replaced: what others put there is theirs, and a
    shell may stand in it.

    Args:
        files: what a folder of this kind may hold; the first marks the kind.
    """
    check_free(path, overwrite, files[0])
    target = Path(path).resolve()
    beside = target.with_name(f".{target.name}.{os.getpid()}.part")
    with _parents_made(beside):
        beside.mkdir()
        try:
            yield beside
            check_free(path, overwrite, files[0])
            if target.exists():
                _exchange(beside, target, files)
            else:
                beside.rename(target)
        finally:
            shutil.rmtree(beside, ignore_errors=True)


def _exchange(new: Path, folder: Path, files: tuple[str, ...]) -> None:
    """Move what ``new`` holds into ``folder`` in place of ``files``; if that fails, all is as it was.

    The mark goes first and comes last, so that a run that is killed leaves no mixture that looks whole.
    """
    arriving = sorted((entry.name for entry in new.iterdir()), key=lambda name: name == files[0])
    leaving = [name for name in dict.fromkeys([*files, *arriving]) if (folder / name).exists()]
    old = new.with_suffix(".old")
    old.mkdir()
    moves = [(folder / name, old / name) for name in leaving]
    moves += [(new / name, folder / name) for name in arriving]
    try:
        for source, target in moves:
            source.rename(target)
    except BaseException:
        for source, target in reversed(moves):
            if target.exists() and not source.exists():
                target.rename(source)
        old.rmdir()
        raise
    shutil.rmtree(old)


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

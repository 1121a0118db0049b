"""Outputs are written whole or not at all: beside their place, then moved into it by one rename.

Only what endotwin wrote is ever replaced: a folder is known by the file that marks its kind. What a killed
run left half written lies under names that begin with ``HIDDEN``, and the next run that writes there removes
it.
"""

from __future__ import annotations

import errno
import filecmp
import json
import os
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from endotwin.errors import OutputError
from endotwin.run import locks
from endotwin.run.arguments import as_path
from endotwin.run.exchange import exchanged

TWIN, DATASET, TRADEOFF, STUDY = "twin.json", "dataset.json", "ladder.json", "study.json"
"""Marks of the folders that endotwin writes."""

HIDDEN = ".endotwin-"
REPLACED = f"{HIDDEN}replaced"
"""Marks a folder whose place another takes."""

ABANDONED_S = 24 * 3600.0
"""Where there are no locks, what is older was left by a run that was killed."""

IN_PYTHON = "in Python overwrite=True"


def check_free(path: Path, overwrite: bool, mark: str | None = None) -> None:
    """Raise OutputError if ``path`` exists and may not be overwritten, or if its folder cannot hold it.

    Args:
        mark: of a folder to be written, the file without which one that is there is not endotwin's to
            replace; None where ``path`` is to be a file.
    """
    path = as_path("output", path)
    if path.exists():
        _check_own(path, mark)
        if not overwrite:
            raise OutputError(f"{path} exists already; choose another name or pass --overwrite ({IN_PYTHON})")
    places = [path, *path.absolute().parents] if mark else path.absolute().parents
    existing = next(place for place in places if place.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        raise OutputError(f"{path} cannot be written: {existing} is not a folder that you may write to")


def check_picture(path: Path, overwrite: bool) -> None:
    """``check_free`` of a picture, which must be named as a PNG file."""
    if as_path("picture", path).suffix.lower() != ".png":
        raise OutputError(f"{path} is not the name of a PNG picture; let it end in .png")
    check_free(path, overwrite)


def check_apart(path: Path, inputs: Iterable[Path | str | None]) -> None:
    """Raise OutputError if one of ``inputs``, where it is a file or folder, is ``path`` or lies in it."""
    for source in filter(None, inputs):
        if os.path.exists(source) and Path(source).resolve().is_relative_to(Path(path).resolve()):
            raise OutputError(f"{path} cannot be replaced: {source} is read from it; choose another name")


def _check_own(path: Path, mark: str | None) -> None:
    if mark is None:
        if not path.is_file():
            kind = "is a folder" if path.is_dir() else "is a device or pipe"
            raise OutputError(f"{path} {kind}; give the name of a file")
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


def unwritable(path: Path, error: OSError) -> OutputError:
    """``error`` as a sentence that names ``path`` and, where room is what lacks, how much there is."""
    if error.errno not in (errno.ENOSPC, errno.EDQUOT):
        return OutputError(f"{path} cannot be written ({error.strerror or error}); check its folder and disk")
    place = next(place for place in Path(path).absolute().parents if place.exists())
    free_mb = shutil.disk_usage(place).free / 1e6
    return OutputError(f"{path} cannot be written: the disk is full ({free_mb:.1f} MB free); make room")


@contextmanager
def _told(path: Path) -> Iterator[None]:
    """Whatever the system refuses in the block is told of ``path``."""
    try:
        yield
    except OSError as error:
        raise unwritable(path, error) from error


@contextmanager
def whole_file(path: Path, overwrite: bool = False) -> Iterator[Path]:
    """A path to write to, which becomes ``path`` when the block ends well and vanishes when it does not.

    Raises:
        OutputError: ``path`` exists and ``overwrite`` is false, or it cannot be written.
    """
    path = Path(path)
    check_free(path, overwrite)
    target = path.resolve()
    with _told(path), _parents_made(target), _workplace(target.parent) as work:
        beside = work / path.name
        yield beside
        _settle(beside)
        beside.replace(target)
        _settle(target.parent)


def write_folder(
    path: Path, files: Mapping[str, bytes], mark: str, own: re.Pattern, overwrite: bool = False
) -> None:
    """Make the folder ``path`` of ``files`` by name, or turn the one that is there into that.

    At every instant the folder is what it was or what it shall be: the rename of ``mark`` decides. So any
    other name must stand for one content only, whatever the mark says. What others put into the folder stays.

    Args:
        mark: the file without which the folder is not endotwin's. own: names that are endotwin's in it; those
            that ``files`` lacks are removed.

    Raises:
        OutputError: ``path`` exists and ``overwrite`` is false, it is something else, or cannot be written.
    """
    check_free(path, overwrite, mark)
    target = Path(path).resolve()
    with _told(path):
        if target.is_dir():
            sweep(target.parent)
            _exchange(target, files, mark, own)
            return
        with _parents_made(target), _workplace(target.parent) as work:
            new = work / target.name
            new.mkdir()
            _write_all(new, files)
            _settle(new)
            new.rename(target)
            _settle(target.parent)


def write_folder_anew(
    path: Path, files: Mapping[str, bytes], mark: str, own: re.Pattern, overwrite: bool = False
) -> None:
    """``write_folder`` of files whose names say nothing of their content: a new folder takes the place of the
    one that is there (``move_folder``)."""
    check_free(path, overwrite, mark)
    target = Path(path).resolve()
    with _told(path), _parents_made(target), _workplace(target.parent) as work:
        new = work / target.name
        new.mkdir()
        _write_all(new, files)
        _settle(new)
        move_folder(new, target, lambda name: bool(own.fullmatch(str(name))))
        _settle(target.parent)


def write_with_parts(
    path: Path, content: bytes, parts: Mapping[str, bytes], own: re.Pattern, overwrite: bool = False
) -> None:
    """Write the file ``path`` and, beside it, the files that it refers to, by name.

    At every instant ``path`` and what it refers to are the old or the new: its rename decides. So the name of
    a part must stand for one content only.

    Args:
        own: names that no other file refers to; those that ``parts`` lacks are removed.

    Raises:
        OutputError: ``path`` exists and ``overwrite`` is false, or it cannot be written.
    """
    check_free(path, overwrite)
    target = Path(path).resolve()
    with _told(path), _parents_made(target):
        _exchange(target.parent, {**parts, target.name: content}, target.name, own)


def move_folder(new: Path, path: Path, own: Callable[[Path], bool]) -> None:
    """Put the whole folder ``new`` in the place of ``path``, whose files that are not ``own`` go with it.

    Until its last rename ``new`` is whole beside ``path``, and a run that was killed can do the same again.
    Where the system can exchange two names, ``path`` is the old folder or the new one at every instant;
    elsewhere it takes two renames.

    Args:
        own: whether a file of ``path``, by its relative path, is endotwin's to replace.

    Raises:
        OutputError: a file that is not would be lost; OSError: as the system has it.
    """
    path = Path(path).absolute()
    with _workplace(path.parent) as aside:
        old = aside / path.name
        if not path.exists():
            new.rename(path)
        elif was_replaced(new):
            new.rename(old)
        else:
            _adopt(path, new, own)
            (path / REPLACED).write_bytes(b"")
            if exchanged(new, path):
                new.rename(old)
                return
            path.rename(old)
            try:
                new.rename(path)
            except BaseException:
                with suppress(OSError):
                    old.rename(path)
                    (path / REPLACED).unlink()
                raise


def copy_folder(path: Path, copy: Path) -> None:
    """Make ``copy``, which is not there, of the folder ``path``: whole or not at all."""
    with _workplace(Path(copy).absolute().parent) as work:
        shutil.copytree(path, work / "copy")
        (work / "copy").rename(copy)


def goes_on(work: Path, mark: str, asked: dict, another: str) -> bool:
    """Whether the folder ``work`` holds what a run has done so far that ``asked`` the same, as its file
    ``mark`` says. What that was writing when it was killed is swept; a folder whose place another has taken
    is removed.

    Raises:
        OutputError: it holds the results of ``another`` run.
    """
    if was_replaced(work):
        shutil.rmtree(work)
    if not (work / mark).exists():
        return False
    if json.loads((work / mark).read_text(encoding="utf-8")) != asked:
        raise OutputError(f"{work} holds the results of {another}; delete it or choose another -o")
    for folder in {left.parent for left in work.rglob(f"{HIDDEN}*/")}:
        sweep(folder)
    return True


def was_replaced(folder: Path) -> bool:
    """Whether another folder has taken the place of ``folder``, in a run that was killed before it removed
    this one."""
    return (folder / REPLACED).exists()


def _adopt(old: Path, new: Path, own: Callable[[Path], bool]) -> None:
    """Link files of ``old`` that are not ``own`` into ``new``, or copy them where that cannot be."""
    files = (file for file in old.rglob("*") if file.is_symlink() or not file.is_dir())
    for file in files:
        name = file.relative_to(old)
        target = new / name
        if own(name) or name.name == REPLACED:
            continue
        if target.exists():
            if target.samefile(file) or filecmp.cmp(target, file, shallow=False):
                continue  # a run that was killed came so far
            raise OutputError(f"{file} is not endotwin's to replace; move it to another place")
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(file, target, follow_symlinks=False)
        except (OSError, NotImplementedError):
            part = target.with_name(f"{HIDDEN}{target.name}")
            shutil.copy2(file, part, follow_symlinks=False)
            part.replace(target)


def _exchange(folder: Path, files: Mapping[str, bytes], mark: str, own: re.Pattern) -> None:
    """Write ``files`` into a folder that is there; the rename of ``mark`` decides."""
    with _workplace(folder) as work, _locked(folder):
        kept = set(os.listdir(folder))
        fresh = [name for name in files if name != mark and not _holds(folder / name, files[name])]
        try:
            _write_all(work, {name: files[name] for name in [*fresh, mark]})
            for name in fresh:
                (work / name).replace(folder / name)
            _settle(folder)
            (work / mark).replace(folder / mark)
            kept = set(files)
            _settle(folder)
        finally:
            for name in set(os.listdir(folder)) - kept:
                if own.fullmatch(name):
                    (folder / name).unlink()


def _holds(file: Path, content: bytes) -> bool:
    return file.is_file() and file.read_bytes() == content


def _write_all(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files by name, through to the disk."""
    for name, content in files.items():
        with (folder / name).open("wb") as opened:
            opened.write(content)
            opened.flush()
            os.fsync(opened.fileno())


def _settle(place: Path) -> None:
    """Wait until what was written to a file, or which names a folder has, is on the disk."""
    on_windows = os.name == "nt"
    if on_windows and place.is_dir():
        return  # which cannot be opened there
    descriptor = os.open(place, os.O_RDWR if on_windows else os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def _workplace(folder: Path) -> Iterator[Path]:
    """A hidden folder in ``folder`` to write in, gone after the block, as are those of runs that were
    killed."""
    with _locked(folder):
        _remove_left(folder)
        work = Path(tempfile.mkdtemp(prefix=HIDDEN, dir=folder))
        held = locks.take(work)
    try:
        yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)
        locks.release(held)


def sweep(folder: Path) -> None:
    """Remove what runs that were killed left half written in ``folder``."""
    with _locked(folder):
        _remove_left(folder)


def _remove_left(folder: Path) -> None:
    for left in folder.glob(f"{HIDDEN}*/"):
        _remove_abandoned(left)


def _remove_abandoned(work: Path) -> None:
    """Remove a workplace unless its run is alive, which holds its lock."""
    with suppress(OSError):
        if not locks.EXIST and time.time() - work.stat().st_mtime < ABANDONED_S:
            return
        locks.release(locks.take(work, wait=False))
        shutil.rmtree(work, ignore_errors=True)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """No other run enters such a block of the same folder meanwhile."""
    held = locks.take(folder)
    try:
        yield
    finally:
        locks.release(held)

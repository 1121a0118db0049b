"""The unfinished dataset beside its place: what is done stays done, however the run ends."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from endotwin.errors import OutputError
from endotwin.run import locks
from endotwin.run.output import DATASET, IN_PYTHON, check_free, move_folder, sweep, unwritable, was_replaced
from endotwin.synth.run.shard import DATA, DONE

JOB, LOCK, GOING = "job.json", "lock", "going"


class Partial:
    """The folder ``DATASET.partial``: ``data`` (the dataset to be), ``done`` (a mark a shard), ``job.json``.

    Made when a run begins, gone when the dataset is whole. A run that is killed leaves it, and the same
    command finds it. At the end ``data`` is renamed to its place, and only then is the rest removed,
    ``job.json`` last: so the same command can tell at any moment how far it came.
    """

    def __init__(self, out: Path):
        self.out = out
        self.path = partial_path(out)
        self._missing = [folder for folder in self.path.parents if not folder.exists()]

    @contextmanager
    def claimed(self, digest: str, overwrite: bool) -> Iterator[bool]:
        """Hold the folder for the job of this digest; gives whether its dataset is whole already.

        Raises:
            OutputError: the dataset exists, another job or another run holds the folder, or it cannot be
            made.
        """
        if not self._just_finished(digest):
            check_free(self.out, overwrite, DATASET)
        if self.path.exists() and any(self.path.iterdir()) and not (self.path / LOCK).exists():
            raise OutputError(f"{self.path} is no unfinished dataset; move it away, or choose another name")
        with self._locked():
            finished = self._just_finished(digest)
            if finished:
                sweep(self.out.absolute().parent)
                self.remove()
            elif self._digest() != digest:
                self._begin(digest, overwrite)
            yield finished

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Hold the lock of a run that is at work here, in the folder, which is made."""
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            (self.path / LOCK).touch()
            held = locks.take(self.path / LOCK, wait=False)
        except BlockingIOError as error:
            raise OutputError(f"{self.path} is at work in another run; wait for it or end it") from error
        except OSError as error:
            self._vanish()
            raise unwritable(self.path, error) from error
        try:
            yield
        finally:
            locks.release(held)

    @property
    def data(self) -> Path:
        """Where the dataset grows."""
        return self.path / DATA

    def finish(self) -> None:
        """Put the dataset, now whole, in its place; what others put into the one that it replaces stays."""
        own = _kinds_of(self.out)
        move_folder(self.data, self.out, lambda name: own is None or _kind(name) in own)
        self.remove()

    def kinds(self) -> list[str]:
        """Kinds of files in ``data``, less what others put into the dataset that it replaces."""
        own = _kinds_of(self.out)
        guests = set() if own is None else {name for name in _files(self.out) if _kind(name) not in own}
        return sorted({_kind(name) for name in _files(self.data) if name not in guests})

    def remove(self) -> None:
        """Remove all that is left of the unfinished dataset."""
        for name in (DATA, DONE, f"{JOB}.part", JOB, LOCK):
            self._discard(name)
        self._vanish()

    def _vanish(self) -> None:
        """Remove the folder, now empty, and the parents that it was made with."""
        with suppress(OSError):  # not empty: the dataset got its place there, or someone else's is
            for folder in [self.path, *self._missing]:
                folder.rmdir()

    def _begin(self, digest: str, overwrite: bool) -> None:
        """Make the folder one of this job; ``job.json``, written last, says that it is."""
        if self._digest() is not None and not overwrite:
            raise OutputError(
                f"{self.path} is an unfinished dataset of another command, twin or version; finish or "
                f"remove it, or pass --overwrite ({IN_PYTHON})"
            )
        for name in (JOB, DATA, DONE):
            self._discard(name)
        try:
            for name in (DATA, DONE):
                (self.path / name).mkdir()
            beside = self.path / f"{JOB}.part"
            beside.write_text(json.dumps({"digest": digest}) + "\n", encoding="utf-8")
            beside.replace(self.path / JOB)
        except OSError as error:
            self.remove()
            raise unwritable(self.path, error) from error

    def _digest(self) -> str | None:
        """Of the job that left the folder; None where there is none."""
        try:
            return json.loads((self.path / JOB).read_text(encoding="utf-8"))["digest"]
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError):
            return ""

    def _just_finished(self, digest: str) -> bool:
        """Whether the run of this job was killed after the dataset got its place."""
        placed = not self.data.exists() or was_replaced(self.data)
        return self._digest() == digest and self.out.exists() and placed

    def _discard(self, name: str) -> None:
        entry, going = self.path / name, self.path / GOING
        if entry.is_dir():
            shutil.rmtree(going, ignore_errors=True)
            entry.rename(going)  # at once: a worker of a cluster may live on, and write
        else:
            entry.unlink(missing_ok=True)
        shutil.rmtree(going, ignore_errors=True)


def partial_path(out: Path) -> Path:
    """Where the unfinished dataset of ``out`` grows."""
    return out.absolute().with_name(f"{out.name}.partial")


def _kind(name: Path) -> str:
    """A file's relative path with # for every number: the same for all frames."""
    return re.sub(r"\d+", "#", name.as_posix())


def _files(folder: Path) -> list[Path]:
    """Relative paths of the files below ``folder``."""
    return [file.relative_to(folder) for file in folder.rglob("*") if not file.is_dir()]


def _kinds_of(dataset: Path) -> set[str] | None:
    """Kinds of files that a dataset was made of; None where it does not say."""
    try:
        return set(json.loads((dataset / DATASET).read_text(encoding="utf-8"))["files"])
    except (OSError, ValueError, KeyError, TypeError):
        return None

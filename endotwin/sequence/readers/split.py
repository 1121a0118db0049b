"""Which frames of a ``transforms.json`` are to be fitted, and which are to be scored by."""

from __future__ import annotations

import posixpath
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from endotwin.errors import SequenceError
from endotwin.sequence.poses import natural_order
from endotwin.sequence.sequence import Split

TRAINING, HELD_OUT, VALIDATION = "train_filenames", "test_filenames", "val_filenames"


@dataclass(frozen=True)
class Listing:
    """What one file lists.

    Attributes:
        file, content: it. T_world_camera: float64 [N, 4, 4]. frames: its N entries. color_files, depth_files:
            N paths. level_mm: millimetres of a level of the depth maps.
    """

    file: Path
    content: dict
    T_world_camera: np.ndarray
    frames: list[dict]
    color_files: list[Path]
    depth_files: list[Path]
    level_mm: float


def joined(listings: list[Listing]) -> Listing:
    """All frames of some files of one folder, in the order of their photos' names."""
    if len(listings) == 1:
        return listings[0]
    photos = [photo for listing in listings for photo in listing.color_files]
    order = sorted(range(len(photos)), key=lambda index: natural_order(str(photos[index])))

    def ordered(column: str) -> list:
        values = [value for listing in listings for value in getattr(listing, column)]
        return [values[index] for index in order]

    columns = {column: ordered(column) for column in ("frames", "color_files", "depth_files")}
    return replace(listings[0], T_world_camera=np.array(ordered("T_world_camera")), **columns)


def of_files(listings: list[Listing], every: Listing) -> Split:
    """The split of two files, one of frames to be fitted and one of those held out, which ``every`` joins."""
    training, heldout = (set(listing.color_files) for listing in listings)
    if training & heldout:
        raise SequenceError(
            f"{min(training & heldout)} is in {listings[0].file.name} and {listings[1].file.name}; let only "
            "one of them have it"
        )
    photos = list(enumerate(every.color_files))
    return Split(
        tuple(index for index, photo in photos if photo in training),
        tuple(index for index, photo in photos if photo in heldout),
    )


def of_lists(listing: Listing) -> Split | None:
    """The split of the lists of file names in a file; None where it has none.

    Where nothing is said to be held out, that is what is not said to be fitted; and the other way round.
    """
    lists = {key: _named(listing, key) for key in (TRAINING, HELD_OUT, VALIDATION) if key in listing.content}
    if not lists:
        return None
    everything = set(range(len(listing.frames)))
    training = lists.get(TRAINING, everything - set().union(*lists.values()))
    heldout = lists.get(HELD_OUT) or lists.get(VALIDATION) or everything - training
    if both := training & heldout:
        name = listing.frames[min(both)]["file_path"]
        raise SequenceError(f"{listing.file} lists {name} to be fitted and held out; remove it from one list")
    return Split(tuple(sorted(training)), tuple(sorted(heldout)))


def as_lists(listings: list[Listing]) -> dict[str, list[str]]:
    """The lists of file names by which one file says the split of two, as ``of_files`` tells it."""
    names = ([frame["file_path"] for frame in listing.frames] for listing in listings)
    return dict(zip((TRAINING, HELD_OUT), names, strict=True))


def _named(listing: Listing, key: str) -> set[int]:
    """Indices of the frames that the list ``key`` names."""
    names = listing.content[key]
    if not isinstance(names, list):
        raise SequenceError(f"{listing.file}: {key!r} is no list of file names; export the file again")
    index = {posixpath.normpath(frame["file_path"]): number for number, frame in enumerate(listing.frames)}
    plain = [posixpath.normpath(str(name)) for name in names]
    for name in plain:
        if name not in index:
            raise SequenceError(
                f"{listing.file}: {key!r} names {name}, which is no frame; remove it, or add the frame"
            )
    return {index[name] for name in plain}

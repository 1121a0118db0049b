"""Pictures that another method rendered of held-out frames: which file shows which frame."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence as Indices
from pathlib import Path

import numpy as np

from endotwin.errors import SequenceError
from endotwin.sequence import Sequence
from endotwin.sequence.images import read_color
from endotwin.sequence.poses import natural_order

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")

logger = logging.getLogger("endotwin")


def rendered_files(folder: Path, sequence: Sequence, frames: Indices[int]) -> dict[int, Path]:
    """The picture in ``folder`` of each of ``frames``.

    It is called as the frame's photo is, or has the photo's number in its name, or the frame's index. Where
    no rule gives all of them and there are as many pictures as frames, they are taken in order, with a
    warning: 3DGS and NeRF repositories number the held-out frames anew.

    Raises:
        SequenceError: a frame has no picture.
    """
    if not folder.is_dir():
        raise SequenceError(f"{folder} is no folder; name the one that holds the renders")
    found = sorted(
        (file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES),
        key=lambda file: natural_order(file.name),
    )
    by_stem, by_number = {file.stem: file for file in found}, {_number(file): file for file in found}
    if twins := [file for file in found if by_stem[file.stem] != file]:
        other = by_stem[twins[0].stem].name
        raise SequenceError(f"{twins[0]} and {other} show the same frame; remove one of them")
    rules = [{index: by_stem.get(sequence.color_files[index].stem) for index in frames}]
    if len(by_number) == len(found):
        rules.append({index: by_number.get(_number(sequence.color_files[index])) for index in frames})
        rules.append({index: by_number.get(index) for index in frames})
    for rule in rules:
        if all(rule.values()) and len(set(rule.values())) == len(rule):
            return rule
    if len(found) == len(frames):
        logger.warning(
            "the renders in %s have neither names nor numbers of the photos: taken in order, %s as %s",
            *(folder, found[0].name, sequence.color_files[frames[0]].name),
        )
        return dict(zip(frames, found, strict=True))
    lost = next((index for index, file in rules[0].items() if file is None), frames[0])
    raise SequenceError(
        f"{folder} has {len(found)} pictures, but none of held-out frame {sequence.color_files[lost].name}; "
        f"render the {len(frames)} held-out frames and name each as its photo"
    )


def read_render(file: Path, shape: tuple[int, int]) -> np.ndarray:
    """A picture as float32 [H, W, 3] in [0, 1]; raises SequenceError where it is not of ``shape``, (H, W)."""
    color = read_color(file)
    if color.shape[:2] != shape:
        size = "×".join(map(str, color.shape[1::-1]))
        raise SequenceError(
            f"{file} is {size}, but the photos are {shape[1]}×{shape[0]}; render that size, or give --scale"
        )
    return color.astype(np.float32) / 255


def _number(file: Path) -> int | None:
    """The last number in a file's name before its suffix."""
    found = re.findall(r"\d+", file.stem)
    return int(found[-1]) if found else None

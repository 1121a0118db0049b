"""Depth as floating-point numbers, as simulators and other methods write it: NPY, NPZ and OpenEXR."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from io import StringIO
from pathlib import Path
from threading import Lock

import numpy as np
import OpenEXR

from endotwin.errors import SequenceError

SUFFIXES = (".exr", ".npy", ".npz")
CHANNELS = ("Z", "depth", "Depth", "V", "Y", "R")
"""Names under which depth lies in an OpenEXR file of several channels, the likeliest first."""

FARTHEST_MM = 1e6
"""Beyond it a value is the background of a renderer, which is no surface."""

_OUTPUT = Lock()


def read_array(path: Path) -> np.ndarray:
    """The numbers [H, W] in a file of one of ``SUFFIXES``. Raises SequenceError where there are none."""
    read = _exr_channel if path.suffix.lower() == ".exr" else _numpy_array
    try:
        plane = np.squeeze(read(path))
    except SequenceError:
        raise
    except Exception as error:  # these libraries raise whatever the wrong bytes lead them to
        raise SequenceError(f"{path} is truncated or no {path.suffix} file; copy the file again") from error
    if plane.ndim != 2:
        raise SequenceError(f"{path} has the shape {plane.shape}; write it as [height, width]")
    if plane.dtype.kind not in "uif":
        raise SequenceError(f"{path} holds {plane.dtype}, which is no depth; write numbers")
    return plane


def in_mm(values: np.ndarray, unit_mm: float) -> np.ndarray:
    """Depth float32 [H, W], mm, of values in a unit; NaN where they are not positive, or no distance."""
    with np.errstate(over="ignore"):
        depth_mm = values.astype(np.float32) * np.float32(unit_mm)
    depth_mm[~((depth_mm > 0) & (depth_mm < FARTHEST_MM))] = np.nan
    return depth_mm


def _numpy_array(path: Path) -> np.ndarray:
    found = np.load(path, allow_pickle=False)
    if isinstance(found, np.ndarray):
        return found
    with found:
        name = "depth" if "depth" in found.files or len(found.files) != 1 else found.files[0]
        if name not in found.files:
            raise SequenceError(f"{path} has no array 'depth' but {', '.join(found.files)}; name it so")
        return found[name]


def _exr_channel(path: Path) -> np.ndarray:
    with _hushed():
        channels = OpenEXR.File(str(path), separate_channels=True).channels()
    known = [name for name in CHANNELS if name in channels]
    if not known and len(channels) != 1:
        raise SequenceError(f"{path} has no channel Z but {', '.join(sorted(channels))}; name it so")
    return channels[known[0] if known else next(iter(channels))].pixels


@contextmanager
def _hushed() -> Iterator[None]:
    """OpenEXR prints what it dislikes; it is told in our own error."""
    with _OUTPUT, open(os.devnull, "wb") as nothing:
        kept = [os.dup(number) for number in (1, 2)]
        try:
            for number in (1, 2):
                os.dup2(nothing.fileno(), number)
            with redirect_stdout(StringIO()):  # some of it by Python's own print
                yield
        finally:
            for number, before in zip((1, 2), kept, strict=True):
                os.dup2(before, number)
                os.close(before)

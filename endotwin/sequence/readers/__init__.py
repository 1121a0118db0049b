"""Readers of the sequence layouts in use, by name, and the door that all of them share."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import ModuleType

from endotwin.errors import OptionError, SequenceError
from endotwin.run.arguments import as_path, check_positive, check_whole
from endotwin.sequence.readers import c3vd, simcol, transforms, tum
from endotwin.sequence.sequence import Sequence
from endotwin.sequence.undistorted import Undistorted

__all__ = ["FORMATS", "open_sequence"]

FORMATS: dict[str, ModuleType] = {"c3vd": c3vd, "transforms": transforms, "simcol": simcol, "tum": tum}

LEAST_PX = 8
"""Height and width below which an image that was made smaller shows nothing."""


def open_sequence(
    path: Path | str,
    format: str | None = None,
    scale: float = 1.0,
    undistort: tuple[int, int] | None = None,
) -> Sequence:
    """Open a posed RGB-D sequence.

    Args:
        path: its folder, or its ``transforms.json``.
        format: one of ``FORMATS``; detected from the content unless given.
        scale: factor on the image size, at most 1; the camera is scaled with it.
        undistort: width and height of a pinhole image to resample to, as published comparisons do; None: no.

    Raises:
        SequenceError: the folder, its files or its poses cannot be used; the message names file and remedy.
        CameraError: the camera is unknown or impossible.
        OptionError: there is no such format or scale.
    """
    path, scale = as_path("sequence", path), check_positive("scale", scale)
    if format is not None and format not in FORMATS:
        raise OptionError(f"There is no format {format!r}; choose one of {', '.join(FORMATS)}")
    if scale > 1:
        raise OptionError(f"A scale of {scale:g} enlarges the photos, which adds nothing; choose 1 or less")
    if not path.exists():
        raise SequenceError(f"There is no folder {path}; check the path")
    reader = FORMATS[format] if format else _detected(path)
    if path.is_file() and reader is not transforms:
        raise SequenceError(f"{path} is a file; name the folder that holds the sequence")
    if not reader.detects(path):
        raise SequenceError(
            f"{path} is not in the layout {format}, as it has no {reader.MARK}; name no format"
        )
    sequence = reader.read(path)
    sequence.check()
    if undistort is not None:
        if not isinstance(undistort, tuple | list) or len(undistort) != 2:
            raise OptionError(f"a size to undistort to is a width and a height, and not {undistort!r}")
        named = zip(("width", "height"), undistort, strict=True)
        size = [check_whole(f"{name} to undistort to", value, 1) for name, value in named]
        if scale != 1:
            raise OptionError(
                "a size to undistort to is the size of the images, at a scale of 1; leave the scale out, or "
                "where a config has another, pass --scale 1 (in Python scale=1)"
            )
        return Undistorted.of(sequence, *size)
    if scale == 1:
        return sequence
    camera = sequence.camera.scaled(scale)
    if min(camera.width, camera.height) < LEAST_PX:
        raise OptionError(
            f"A scale of {scale:g} leaves {camera.width}×{camera.height} pixels, too few; choose 0.5, say"
        )
    return replace(sequence, camera=camera, scale=scale)


def _detected(path: Path) -> ModuleType:
    for reader in FORMATS.values():
        if reader.detects(path):
            return reader
    if path.is_file():
        raise SequenceError(f"{path} is a file; name the folder that holds the sequence")
    if not any(path.iterdir()):
        raise SequenceError(f"{path} is empty and has no frames; name the folder that holds the photos")
    inside = sorted(entry for entry in path.iterdir() if entry.is_dir())
    for folder in inside:
        if any(reader.detects(folder) for reader in FORMATS.values()):
            raise SequenceError(f"{path} has no frames itself, but {folder.name} in it has; name {folder}")
    marks = ", ".join(f"{name} ({reader.MARK})" for name, reader in FORMATS.items())
    raise SequenceError(
        f"{path} has no frames in a known layout, which are {marks}; check it or name its format"
    )

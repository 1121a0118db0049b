"""Frames told apart by the number in their file names, as C3VD and SimCol3D do it."""

from __future__ import annotations

import re
from pathlib import Path

from endotwin.errors import SequenceError


def numbered_files(folder: Path, pattern: str) -> dict[int, Path]:
    """Files whose whole name matches ``pattern``, by the number in its first group, in numeric order."""
    matches = [(re.fullmatch(pattern, entry.name), entry) for entry in folder.iterdir()]
    found: dict[int, Path] = {}
    for number, entry in sorted((int(match[1]), entry) for match, entry in matches if match):
        if number in found:
            raise SequenceError(f"{found[number]} and {entry.name} have the same number; remove one of them")
        found[number] = entry
    return found


def paired(
    color: dict[int, Path], depth: dict[int, Path], folder: Path
) -> tuple[tuple[Path, ...], tuple[Path, ...]]:
    """Photos and depth maps of equal numbers. Raises SequenceError where there is none, or no pair."""
    if not color:
        raise SequenceError(f"{folder} has no frames; name the folder that holds the photos")
    for number in sorted(color.keys() ^ depth.keys()):
        have, lacks = (color, "depth map") if number in color else (depth, "photo")
        raise SequenceError(f"{have[number]} has no {lacks} of the same number; add it or remove the file")
    return tuple(color.values()), tuple(depth[number] for number in color)

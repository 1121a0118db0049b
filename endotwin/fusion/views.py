"""The depth maps of a sequence as measured distances along rays, a few frames in memory at a time."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from endotwin.fusion.faces import distance_mm
from endotwin.run.ahead import ahead
from endotwin.sequence import Sequence

logger = logging.getLogger("endotwin")

SHELF_BYTES = 256_000_000
"""Fusion reads its frames seven times; this holds 200 of VGA's size."""


@dataclass(frozen=True)
class View:
    """One depth map, in millimetres along each pixel's ray.

    Attributes:
        index: position in the sequence.
        T_world_camera: float64 [4, 4].
        distance_mm: float32 [H, W], NaN where nothing was measured.
    """

    index: int
    T_world_camera: np.ndarray
    distance_mm: np.ndarray


class Shelf:
    """Views that are read again and again; the first that come stay, up to SHELF_BYTES of them."""

    def __init__(self) -> None:
        self._kept: dict[int, View] = {}
        self._left = SHELF_BYTES

    def view(self, index: int, read: Callable[[int], View]) -> View:
        """The view kept for ``index``, or what ``read`` gives."""
        if index in self._kept:
            return self._kept[index]
        view = read(index)
        if view.distance_mm.nbytes <= self._left:
            self._kept[index] = view
            self._left -= view.distance_mm.nbytes
        return view


def read_views(
    sequence: Sequence,
    frames: Iterable[int],
    warn: bool = False,
    shelf: Shelf | None = None,
    change: Callable[[View], View] = lambda view: view,
) -> Iterator[View]:
    """Views of ``frames``, the next one decoded while this one is used; frames without any depth are left
    out.

    Args:
        warn: log a warning that names each frame left out.
        shelf: where views are kept for the next time.
        change: what is done to each view that is read, before it is kept.
    """
    shelf = shelf or Shelf()

    def read(index: int) -> View:
        distances_mm = distance_mm(sequence.camera, sequence.depth_mm(index))
        return change(View(index, sequence.T_world_camera[index], distances_mm))

    for view in ahead(lambda index: shelf.view(index, read), frames):
        if np.isfinite(view.distance_mm).any():
            yield view
        elif warn:
            warn_skipped(sequence, view.index)


def warn_skipped(sequence: Sequence, index: int) -> None:
    """Name a frame that has no depth in the log."""
    logger.warning("%s has no valid depth and is skipped.", sequence.depth_files[index])

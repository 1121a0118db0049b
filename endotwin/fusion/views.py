"""The depth maps of a sequence as measured distances along rays, a few frames in memory at a time."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from endotwin.ahead import ahead
from endotwin.fusion.faces import distance_mm
from endotwin.sequence import Sequence

logger = logging.getLogger("endotwin")


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


def read_views(sequence: Sequence, frames: Iterable[int], warn: bool = False) -> Iterator[View]:
    """Views of ``frames``, the next one decoded while this one is used; frames without any depth are left
    out.

    Args:
        warn: log a warning that names each frame left out.
    """

    def read(index: int) -> View:
        return View(
            index, sequence.T_world_camera[index], distance_mm(sequence.camera, sequence.depth_mm(index))
        )

    for view in ahead(read, frames):
        if np.isfinite(view.distance_mm).any():
            yield view
        elif warn:
            logger.warning("%s has no valid depth and is skipped.", sequence.depth_files[view.index])

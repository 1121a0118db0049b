"""What a camera sees of the surface: how far it goes, and what lies beside rims."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from endotwin.align.scene import Scene
from endotwin.surface.casting import Correspondences
from endotwin.surface.silhouettes import dilated, discontinuities

BAND_SIGMAS = 2.5
"""A rim shows within so many widths of the blur."""


@dataclass(frozen=True, eq=False)
class View:
    """What is seen of a scene from ``T_world_camera`` [4, 4] where photos are blurred by ``sigma_px``.

    Attributes:
        distances: float32 [H, W], how far each pixel's ray goes, mm; 0 where it meets nothing. ends: bool
            [H, W], where that jumps. band: bool [H, W], pixels in which jumps between two surfaces show.
        hits: of those, and of the pixels from which the blur brings something to them.
    """

    T_world_camera: np.ndarray
    sigma_px: float
    distances: np.ndarray
    ends: np.ndarray
    band: np.ndarray
    hits: Correspondences

    @classmethod
    def of(cls, scene: Scene, T_world_camera: np.ndarray, sigma_px: float) -> View:
        hits = scene.caster.cast(scene.camera, T_world_camera)
        distances, reach = scene.distances(hits), band_px(sigma_px)
        ends, inside = discontinuities(distances), ~dilated(distances == 0, 1)
        band = dilated(ends & inside, reach)
        hits = hits[dilated(band, reach).reshape(-1)[hits.pixel]]
        return cls(T_world_camera, sigma_px, distances, ends, band, hits)


def band_px(sigma_px: float) -> int:
    """How many pixels beside a rim it shows."""
    return int(np.ceil(BAND_SIGMAS * sigma_px))

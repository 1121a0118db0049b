"""Pixels as sightings of places on the surface, with the geometry that tells how each is lit."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from endotwin.effects.vignetting import squared_radius
from endotwin.light.guides import visible_in_views
from endotwin.pixels.start import trust

if TYPE_CHECKING:
    from endotwin.pixels.samples import Samples
    from endotwin.surface.casting import Caster
    from endotwin.twin import Twin


DRIFT = 0.5
"""What comes from all around changes little while the tip and what it looks at move by less than this share
of the median viewing distance, root mean square."""

LEAST_DRIFT = 1e-2
"""Variance, of one a frame, below which a function of the path is left out."""


class Sightings:
    """N pixels and the vertices that they show.

    Attributes:
        samples: the pixels. vertex: int [N], numbered without gaps.
    """

    def __init__(self, samples: Samples, vertex: np.ndarray, twin: Twin, caster: Caster):
        self.samples, self.vertex, self.twin, self.caster = samples, vertex, twin, caster

    def __len__(self) -> int:
        return len(self.vertex)

    @cached_property
    def frames(self) -> np.ndarray:
        """The frames that the pixels come from, ascending."""
        return np.unique(self.samples.frame.numpy())

    @cached_property
    def frame(self) -> np.ndarray:
        """Position of each pixel's frame in ``frames``, int [N]."""
        return np.searchsorted(self.frames, self.samples.frame.numpy())

    @cached_property
    def T_local_camera(self) -> np.ndarray:
        """Poses of ``frames`` in the surface's frame, float64 [F, 4, 4]."""
        views = self.samples.views
        return views.T_local_camera[np.searchsorted(views.frames, self.frames)]

    @cached_property
    def drifts(self) -> np.ndarray:
        """Functions of the frame that change smoothly along the path, [F, R]: with coefficients of variance 1
        they make a Gaussian process of variance 1 (principal components of its covariance)."""
        distance_mm, T = self.samples.distance_mm, self.T_local_camera
        tips_mm = T[:, :3, 3]
        ways_mm = np.stack([tips_mm, tips_mm + distance_mm * T[:, :3, 2]])
        apart = np.linalg.norm(ways_mm[:, :, None] - ways_mm[:, None], axis=-1) / distance_mm
        covariance = np.exp(-np.square(apart).mean(axis=0) / (2 * DRIFT**2))
        variances, functions = np.linalg.eigh(covariance)
        kept = variances > LEAST_DRIFT
        return functions[:, kept] * np.sqrt(variances[kept])

    @cached_property
    def points_mm(self) -> np.ndarray:
        """Surface points in the camera frame, float32 [N, 3]."""
        return self.samples.points_mm

    @cached_property
    def normals(self) -> np.ndarray:
        """Unit normals in the camera frame, float32 [N, 3]."""
        return self.samples.normals(self.twin.surface)

    @cached_property
    def local_points_mm(self) -> np.ndarray:
        """Surface points in the surface's frame, float32 [N, 3]."""
        return self._interpolated(self.twin.surface.vertices_mm)

    @cached_property
    def local_normals(self) -> np.ndarray:
        """Normals in the surface's frame, float32 [N, 3]."""
        return self._interpolated(self.twin.surface.normals)

    def visible(self, guides_mm: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Bool [N, K]: which of guides [K, 3] (camera frame) see each pixel's point (or of those in
        ``rows``)."""
        rows = slice(None) if rows is None else rows
        points_mm = self.local_points_mm[rows]
        return visible_in_views(self.caster, self.T_local_camera, self.frame[rows], points_mm, guides_mm)

    def lit(self, guides_mm: np.ndarray, shadows: bool) -> np.ndarray:
        """Bool [N]: whether any of guides [K, 3] lies before each point's surface and, with ``shadows``, is
        seen from there."""
        towards = np.asarray(guides_mm, np.float32) - self.points_mm[:, None]
        before = np.einsum("nka,na->nk", towards, self.normals) > 0
        return (before & self.visible(guides_mm) if shadows else before).any(axis=1)

    @cached_property
    def trust(self) -> np.ndarray:
        """Inverse variance of what each pixel tells of light, up to one factor, [N]."""
        return trust(self.samples.cos.numpy().astype(np.float64))

    @cached_property
    def shown_colors(self) -> np.ndarray:
        """Display values of each pixel, in 0 … 1 and not 0, float64 [N, 3]."""
        return np.maximum(self.samples.color.numpy(), 1) / 255

    @cached_property
    def shown(self) -> np.ndarray:
        """Mean display value of each pixel, 0 … 1, [N]."""
        return self.samples.color.numpy().mean(axis=1, dtype=np.float64) / 255

    def _interpolated(self, per_vertex: np.ndarray) -> np.ndarray:
        corners = per_vertex[self.twin.surface.triangles[self.samples.triangle.numpy()]]
        return np.einsum("nk,nka->na", self.samples.barycentric.numpy(), corners)

    @cached_property
    def vignetting_column(self) -> np.ndarray:
        """r² of each pixel, r = 1 at the middle of the image's shorter side, [N]. No r⁴ beside it: light of
        another exponent n is darker towards the rim in nearly the same way, and would lose its n to both."""
        return squared_radius(self.twin.camera, self.samples.pixel.numpy())

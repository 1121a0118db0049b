"""How a surface agrees with what each pixel measured."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from endotwin.cameras import Camera
from endotwin.fusion.views import View
from endotwin.robust import robust_std
from endotwin.run.ahead import ahead
from endotwin.surface import Surface
from endotwin.surface.casting import Caster


@dataclass(frozen=True)
class Tolerance:
    """How far a hit may lie from the measured distance: max(``absolute_mm``, ``relative`` · distance)."""

    absolute_mm: float
    relative: float

    @classmethod
    def of(cls, voxel_mm: float, noise: float) -> Tolerance:
        """What a surface can be held to: 1.5 voxels, 1% of the distance, or 4σ of relative ``noise``."""
        return cls(1.5 * voxel_mm, max(0.01, 4 * noise))

    def at(self, distance_mm: np.ndarray) -> np.ndarray:
        """Tolerance in mm at distances of any shape."""
        return np.maximum(np.float32(self.absolute_mm), np.float32(self.relative) * distance_mm)


@dataclass(frozen=True)
class Comparison:
    """One view against a surface, per pixel, row-major [H·W]; all false where nothing was measured.

    Attributes:
        view: the view compared.
        residual_mm: float32, first hit minus measured distance; inf where nothing is hit, NaN where not
            measured.
        triangle: int32, first triangle hit, -1 where none.
        allowed_mm: float32, the tolerance.
        at: bool, hit where it was measured.
        before: bool, hit in front of what was measured: a membrane.
        lacking: bool, no hit, or one behind what was measured.
    """

    view: View
    residual_mm: np.ndarray
    triangle: np.ndarray
    allowed_mm: np.ndarray
    at: np.ndarray
    before: np.ndarray
    lacking: np.ndarray


@dataclass(frozen=True)
class Agreement:
    """Share of measured pixels that agree with a surface, miss it, see through it, or hit a membrane; sums
    to 1."""

    agrees: float
    misses: float
    sees_through: float
    membrane: float


def compare(
    camera: Camera, caster: Caster, views: Iterable[View], tolerance: Tolerance
) -> Iterator[Comparison]:
    """Each of ``views`` against the caster's surface, the next one being cast while this one is used."""

    def compared(view: View) -> Comparison:
        measured = view.distance_mm.reshape(-1)
        hits = caster.cast(camera, view.T_world_camera, np.isfinite(view.distance_mm))
        residual_mm = np.where(np.isfinite(measured), np.float32(np.inf), np.float32(np.nan))
        residual_mm[hits.pixel] = hits.distance_mm - measured[hits.pixel]
        triangle = np.full(len(measured), -1, np.int32)
        triangle[hits.pixel] = hits.triangle
        allowed_mm = tolerance.at(measured)
        at = np.abs(residual_mm) <= allowed_mm
        before, lacking = residual_mm < -allowed_mm, residual_mm > allowed_mm
        return Comparison(view, residual_mm, triangle, allowed_mm, at, before, lacking)

    yield from ahead(compared, views)


def measured_noise(camera: Camera, surface: Surface, views: Iterable[View]) -> float:
    """Spread of the measured distances about ``surface``, relative to the distance.

    It is 1.48 · the median absolute residual, so that folds which the surface lacks do not count.
    """
    spreads = []
    for seen in compare(camera, Caster(surface), views, Tolerance(np.inf, 0.0)):
        hit = np.isfinite(seen.residual_mm)
        if hit.any():
            measured_mm = seen.view.distance_mm.reshape(-1)[hit]
            spreads.append(np.median(np.abs(seen.residual_mm[hit]) / measured_mm))
    return robust_std(np.array(spreads))


def agreement(camera: Camera, surface: Surface, views: Iterable[View], tolerance: Tolerance) -> Agreement:
    """How well ``surface`` explains every measured pixel of ``views``."""
    tally = np.zeros(4, np.int64)
    for seen in compare(camera, Caster(surface), views, tolerance):
        misses = seen.lacking & (seen.triangle < 0)
        tally += [seen.at.sum(), misses.sum(), (seen.lacking & ~misses).sum(), seen.before.sum()]
    return Agreement(*(tally / max(tally.sum(), 1)).tolist())


def against(
    camera: Camera, surface: Surface, points_mm: np.ndarray, view: View, tolerance: Tolerance
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bool [N]: which of ``points_mm`` [N, 3], in the surface's frame, lie in the picture of ``view``; and of
    those, bool each, which lie before what was measured about them, and which at it."""
    T_local_camera = surface.to_local(view.T_world_camera).astype(np.float32)
    ray_mm = points_mm - T_local_camera[:3, 3]
    uv = camera.project(ray_mm @ T_local_camera[:3, :3])
    with np.errstate(invalid="ignore"):
        inside = ((uv >= 0) & (uv <= (camera.width - 1, camera.height - 1))).all(axis=1)
    distance_mm = np.linalg.norm(ray_mm[inside], axis=1)
    nearest_mm, farthest_mm = about(view.distance_mm, uv[inside])
    before = distance_mm < nearest_mm - tolerance.at(nearest_mm)
    at = ~before & (distance_mm <= farthest_mm + tolerance.at(farthest_mm))
    return inside, before, at


def about(distance_mm: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest distance [N] that the four pixels about ``uv`` [N, 2] measured; -inf where none
    did."""
    height, width = distance_mm.shape
    column, row = np.minimum(uv.astype(np.int32), (width - 2, height - 2)).T
    first = row * width + column
    flat = distance_mm.reshape(-1)
    near = [flat[first + step] for step in (0, 1, width, width + 1)]
    nearest_mm = np.fmin(np.fmin(near[0], near[1]), np.fmin(near[2], near[3]))
    farthest_mm = np.fmax(np.fmax(near[0], near[1]), np.fmax(near[2], near[3]))
    return np.nan_to_num(nearest_mm, nan=-np.inf), np.nan_to_num(farthest_mm, nan=-np.inf)

"""Points of one frame in another: where they land, and how far the depth measured there is from theirs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from endotwin.check.depths import LEAST_COSINE, lookup
from endotwin.check.reading import Reading
from endotwin.check.views import Views

CAP = 0.05
"""A residual of so much, in ln z, counts as no agreement at all; so does a point that lands nowhere."""


@dataclass(frozen=True)
class Disagreement:
    """How well a reading makes frames agree.

    Attributes:
        median: median |ln z − ln z measured| of the points that land on measured depth; NaN where none do.
        lands: share of the points that do.
        cost: mean over all points of min(|residual| / cap, 1): 0 is perfect, 1 is no agreement.
    """

    median: float
    lands: float
    cost: float


def cap(views: Views) -> float:
    """The residual from which a point does not agree: ``CAP``, or eight times the noise."""
    return max(CAP, 8 * views.left)


def relative_poses(T: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation [P, 3, 3] and translation [P, 3] that take points from camera ``ends[:, 0]`` into
    ``ends[:, 1]``."""
    (R_from, t_from), (R_to, t_to) = ((T[ends[:, k], :3, :3], T[ends[:, k], :3, 3]) for k in (0, 1))
    rotation = np.einsum("nji,njk->nik", R_to, R_from)
    return rotation, np.einsum("nji,nj->ni", R_to, t_from - t_to)


def landed(views: Views, reading: Reading, part: slice | np.ndarray = slice(None)) -> tuple:
    """Points [S, 3] of the samples ``part`` in their target's camera, and their pixels [S, 2] there."""
    camera = views.sequence.camera
    T = reading.poses(views.written, views.frames)
    rotation, translation = relative_poses(T, views.ends)
    rays = camera.directions(reading.lens.calibrated(views.pixel[part]))
    z = views.depth[part] * np.abs(rays[:, 2]) ** reading.ray
    pair = views.pair[part]
    points = np.einsum("nij,nj->ni", rotation[pair], rays * (z / rays[:, 2])[:, None]) + translation[pair]
    return points, reading.lens.image(camera.project(points))


def residuals(views: Views, reading: Reading, part: slice | np.ndarray = slice(None)) -> np.ndarray:
    """ln(z / z measured where the point lands), float64 [S]; NaN where it lands on no measured depth."""
    with np.errstate(all="ignore"):
        points, uv = landed(views, reading, part)
        measured_inverse = lookup(views.inverse, views.target[part], uv)
        cosine = points[:, 2] / np.linalg.norm(points, axis=1)
        residual = np.log(points[:, 2] * measured_inverse) - reading.ray * np.log(cosine)
        return np.where((cosine > LEAST_COSINE) & np.isfinite(residual), residual, np.nan)


def disagreement(views: Views, reading: Reading, part: slice | np.ndarray = slice(None)) -> Disagreement:
    """How far the frames disagree under ``reading``, over the samples ``part``."""
    size = np.abs(residuals(views, reading, part))
    lands = np.isfinite(size)
    if not lands.any():
        return Disagreement(np.nan, 0.0, 1.0)
    limit = cap(views)
    cost = np.where(lands, np.minimum(size, limit), limit).mean() / limit
    return Disagreement(float(np.median(size[lands])), float(lands.mean()), float(cost))

"""Where photos show the rims of folds: what geometry alone predicts, and no albedo can follow.

A rim is where one pixel sees two surfaces. Beside it the photo is compared with the twin, painted with albedo
that is even over millimetres; each side of a stretch of rim may be brighter or darker than predicted. What
remains is the place of the step between them, and that step moves with the nearer surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from endotwin.align.photos import DARKEST, Photo, gradient, log_blurred
from endotwin.align.scene import LEAST_COSINE, Scene, by_twist, shading_columns
from endotwin.align.views import View, band_px
from endotwin.light.incidence import incidence
from endotwin.run.threads import THREADS
from endotwin.surface import Surface
from endotwin.surface.cells import merged

STRETCH_CELLS = 24
"""Cells across the image, in each of which either side of a rim has a brightness of its own."""

FARTHER = 1.05
"""A pixel is on the far side of a rim if it lies so much farther than what is near beside it."""

PAINT_MM = 2.5
NEIGHBOURS = 3


def painted(surface: Surface, points_mm: np.ndarray, log_albedo: np.ndarray) -> np.ndarray:
    """ln of the albedo of every vertex, float32 [V], even over cells of PAINT_MM, from ``log_albedo`` [N] at
    local ``points_mm`` [N, 3]; 0 where there are none."""
    if not len(points_mm):
        return np.zeros(len(surface.vertices_mm), np.float32)
    centre_mm, group = merged(points_mm, PAINT_MM)
    level = np.bincount(group, log_albedo) / np.bincount(group)
    nearest = list(range(1, 1 + min(NEIGHBOURS, len(level))))
    distance_mm, which = cKDTree(centre_mm).query(surface.vertices_mm, nearest, workers=THREADS)
    weight = 1 / (distance_mm + PAINT_MM / 8) ** 2
    return ((level[which] * weight).sum(axis=1) / weight.sum(axis=1)).astype(np.float32)


@dataclass(frozen=True)
class Rim:
    """P pixels beside rims in one photo.

    Attributes:
        residual: float64 [P], ln photo − ln twin. slopes: [P, 9], of it by the camera's twist and
            intrinsics.
        stretch: int [P], side and stretch of rim, numbered without gaps.
    """

    residual: np.ndarray
    slopes: np.ndarray
    stretch: np.ndarray


def rim(scene: Scene, photo: Photo, view: View, paint: np.ndarray, light: np.ndarray) -> Rim:
    """Rims in a photo, blurred as the ``view`` of it is, beside the twin that ``paint`` [V] (see ``painted``)
    makes under ``light`` [6]."""
    (height, width), distances, hits = scene.shape, view.distances, view.hits
    twin, met = np.zeros(height * width, np.float32), np.zeros(height * width, np.float32)
    twin[hits.pixel], met[hits.pixel] = _shaded(scene, view, paint, light), 1
    twin, met = twin.reshape(height, width), met.reshape(height, width)

    shown, holds = photo.blurred(view.sigma_px, met)
    predicted, told = log_blurred(twin, met * photo.shown, view.sigma_px)
    pixel = np.flatnonzero(view.band & holds & told & (predicted > np.log(DARKEST)))
    nearest_mm = least_within(distances, band_px(view.sigma_px)).reshape(-1)[pixel].astype(np.float64)
    slopes = moving_slopes(scene, predicted, pixel, nearest_mm)
    far = distances.reshape(-1)[pixel] > FARTHER * nearest_mm
    cell_px = width / STRETCH_CELLS
    v, u = ((x / cell_px).astype(int) for x in np.divmod(pixel, width))
    stretch = np.unique((v * (STRETCH_CELLS + 1) + u) * 2 + far, return_inverse=True)[1].reshape(-1)
    residual = (shown - predicted).reshape(-1)[pixel].astype(np.float64)
    return Rim(residual, slopes, stretch)


def moving_slopes(
    scene: Scene, predicted: np.ndarray, pixel: np.ndarray, distance_mm: np.ndarray
) -> np.ndarray:
    """Slopes [P, 9], by the camera's twist and intrinsics, of photo − ``predicted`` [H, W] at ``pixel`` [P],
    whose picture moves with a surface at ``distance_mm`` [P]."""
    slopes_uv = [slope.reshape(-1)[pixel].astype(np.float64) for slope in gradient(predicted)]
    points = scene.rays[pixel].astype(np.float64) * distance_mm[:, None]
    uv = np.stack([pixel % scene.shape[1], pixel // scene.shape[1]], axis=1)
    turned = by_twist(scene.by_point(pixel, *slopes_uv, points), points)
    return np.hstack([turned, scene.by_intrinsics(uv, *slopes_uv)])


def least_within(distances: np.ndarray, reach: int) -> np.ndarray:
    """The least of ``distances`` [H, W], in which 0 is none, within ``reach`` of each pixel, float32."""
    beyond = np.where(distances > 0, distances, np.inf).astype(np.float32)
    return cv2.erode(beyond, np.ones((2 * reach + 1,) * 2, np.uint8))


def _shaded(scene: Scene, view: View, paint: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Display value [N] of the view's hits under ``light`` [6]."""
    hits = view.hits
    lit = incidence(hits, scene.surface, scene.camera, view.T_world_camera)
    ray = scene.rays[hits.pixel]
    r2 = scene.squared_radius(np.stack([hits.pixel % scene.shape[1], hits.pixel // scene.shape[1]], axis=1))
    columns = shading_columns(ray[:, 2], hits.distance_mm, np.maximum(lit.cos, LEAST_COSINE), r2)
    return np.exp(hits.interpolate(scene.surface, paint) + columns @ light)

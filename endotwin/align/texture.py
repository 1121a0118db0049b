"""What photos show of the surface's vertices: the same place must look the same in all, once its light is
told."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from endotwin.align.photos import Photo, gradient
from endotwin.align.scene import Scene, by_twist, shading_columns, shading_slopes
from endotwin.align.views import View
from endotwin.surface.silhouettes import dilated

GRAZING, SHINY = 0.1, 0.92
"""Least and largest n·ω of a vertex that tells: beyond, it lies at a rim, or in a highlight."""

RIM_SIGMAS = 3.0
"""So many widths of the blur beside a rim a photo shows both sides of it."""

OCCLUDED_MM, OCCLUDED = 0.05, 0.004
"""A vertex is seen if nothing is so much nearer than it, absolutely and of its distance."""

LIGHT_CELLS = 20
"""Cells across the image whose mean brightness is nobody's: light that the model lacks is smooth in an
image."""


@dataclass(frozen=True)
class Sighted:
    """S vertices in one photo.

    Attributes:
        vertex: int [S], ascending, numbered as in the scene. cell: int [S], of the image.
        shown: float64 [S], ln of the photo's display value. by_twist: [S, 6], of ``shown`` by the camera's
            twist; by_intrinsics: [S, 3], by its intrinsics.
        columns: [S, 6], of the shading. points_mm, normals: [S, 3], camera frame. cos: [S], n·ω.
    """

    vertex: np.ndarray
    cell: np.ndarray
    shown: np.ndarray
    by_twist: np.ndarray
    by_intrinsics: np.ndarray
    columns: np.ndarray
    points_mm: np.ndarray
    normals: np.ndarray
    cos: np.ndarray

    def slopes(self, light: np.ndarray) -> np.ndarray:
        """[S, 9]: of ``shown`` less its shading under ``light`` [6], by the camera's twist and intrinsics."""
        shading = shading_slopes(self.points_mm, self.normals, self.cos, light)
        return np.hstack([self.by_twist - shading, self.by_intrinsics])


def sighted(scene: Scene, photo: Photo, view: View) -> Sighted:
    """The scene's vertices in a photo, blurred as the ``view`` of it is."""
    T = scene.surface.to_local(view.T_world_camera)
    points = (scene.points_mm - T[:3, 3]) @ T[:3, :3]
    normals = scene.normals @ T[:3, :3]
    distance_mm = np.linalg.norm(points, axis=1)
    cos = -(normals * points).sum(axis=1) / distance_mm
    rows = np.flatnonzero((cos > GRAZING) & (cos < SHINY) & (points[:, 2] > 0.2 * distance_mm))
    uv = scene.camera.project(points[rows])
    height, width = scene.shape
    with np.errstate(invalid="ignore"):
        inside = ((uv >= 1) & (uv < (width - 2, height - 2))).all(axis=1)
    rows, uv = rows[inside], uv[inside]

    shown, holds = photo.blurred(view.sigma_px)
    rims = view.ends | (view.distances == 0)
    holds &= ~dilated(rims, int(np.ceil(RIM_SIGMAS * view.sigma_px)))
    nearest = np.rint(uv).astype(int)
    pixel = nearest[:, 1] * width + nearest[:, 0]
    before = view.distances.reshape(-1)[pixel]
    clear = before * (1 + OCCLUDED) + _reach(scene, before, cos[rows]) > distance_mm[rows]
    keep = holds.reshape(-1)[pixel] & clear
    rows, uv, pixel = rows[keep], uv[keep].astype(np.float32), pixel[keep]

    sampled = [_sampled(image, uv) for image in (shown, *gradient(shown))]
    points, cos = points[rows], cos[rows]
    by_point = scene.by_point(pixel, *sampled[1:], points)
    cell_px = width / LIGHT_CELLS
    u, v = (uv / cell_px).astype(int).T
    columns = shading_columns(
        points[:, 2] / distance_mm[rows], distance_mm[rows], cos, scene.squared_radius(uv)
    )
    return Sighted(
        *(rows, v * (LIGHT_CELLS + 1) + u, sampled[0], by_twist(by_point, points)),
        *(scene.by_intrinsics(uv, *sampled[1:]), columns, points, normals[rows], cos),
    )


def _sampled(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Of an image at pixels [N, 2], between them too: float64 [N]. OpenCV refuses to find none."""
    if not len(uv):
        return np.zeros(0)
    return cv2.remap(image, uv[:, None, 0], uv[:, None, 1], cv2.INTER_LINEAR)[:, 0].astype(np.float64)


def _reach(scene: Scene, distance_mm: np.ndarray, cos: np.ndarray) -> np.ndarray:
    """How much farther than its pixel's centre a vertex may lie, [N]: the slope of the surface over a
    pixel."""
    height, width = scene.shape
    centre = scene.pixels_by_direction[height // 2 * width + width // 2]
    pixel_rad = 1 / max(float(np.linalg.norm(centre, axis=1).mean()), 1e-6)
    return OCCLUDED_MM + distance_mm * pixel_rad / cos

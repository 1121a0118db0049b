"""Rays decide what is missing: where a measured pixel misses the surface, that view's own depth is
triangulated."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from endotwin.cameras import Camera
from endotwin.casting import Caster
from endotwin.fusion.agreement import Comparison
from endotwin.fusion.mesh import proper
from endotwin.surface import Surface

WELD_VOXELS = 1.0
"""A patch takes over a vertex of the surface that is this near instead of making its own."""

LEAST_CROWD = 3
"""A pixel that sees through is patched when this many of the nine there lack a surface; fewer is noise."""


class Patches:
    """Patches of a surface, made view by view, each only where no earlier one explains the pixel.

    Vertex numbers continue those of the surface, whose vertices the patches share along their rims.
    """

    def __init__(self, camera: Camera, surface: Surface, voxel_mm: float):
        self._camera = camera
        self._surface = surface
        self._weld_mm = WELD_VOXELS * voxel_mm
        self.vertices_mm = surface.vertices_mm
        self._scenes: list[Caster] = []

    @property
    def triangles(self) -> np.ndarray:
        """Vertex numbers of all patches so far, int32 [P, 3]."""
        none = np.zeros((0, 3), np.int32)
        return np.concatenate([none, *(scene.surface.triangles for scene in self._scenes)])

    def add(self, seen: Comparison) -> None:
        """Triangulate 2×2 neighbours of which at least one lacks a surface and whose distances do not
        jump."""
        lacking = self._unexplained(seen)
        if not lacking.any():
            return
        quads = _smooth_quads(seen.view.distance_mm, lacking, seen.allowed_mm)
        if len(quads) == 0:
            return
        pixel, corner = np.unique(quads, return_inverse=True)
        number = self._welded(self._points(seen, pixel), np.where(seen.at, seen.triangle, -1)[pixel])
        quads = number[corner.reshape(-1, 4)]
        triangles = np.concatenate([quads[:, [0, 2, 1]], quads[:, [1, 2, 3]]])
        self._remember(triangles[proper(triangles)])

    def _remember(self, triangles: np.ndarray) -> None:
        """Add triangles [N, 3] to the scenes.

        Each scene is larger than the next, so that there are few, and few of them are built of any triangle.
        """
        while self._scenes and len(self._scenes[-1].surface.triangles) <= len(triangles):
            triangles = np.concatenate([self._scenes.pop().surface.triangles, triangles])
        if len(triangles):
            patches = replace(self._surface, vertices_mm=self.vertices_mm, triangles=triangles)
            self._scenes.append(Caster(patches))

    def _unexplained(self, seen: Comparison) -> np.ndarray:
        """Bool [H·W]: pixels that lack a surface and that no patch lies at or in front of."""
        shape = seen.view.distance_mm.shape
        crowd = cv2.boxFilter(seen.lacking.reshape(shape).astype(np.float32), -1, (3, 3), normalize=False)
        lacking = seen.lacking & ((seen.triangle < 0) | (crowd.reshape(-1) >= LEAST_CROWD))
        reach_mm = seen.view.distance_mm.reshape(-1) + seen.allowed_mm
        for scene in self._scenes:
            hits = scene.cast(self._camera, seen.view.T_world_camera, lacking.reshape(shape))
            lacking[hits.pixel[hits.distance_mm <= reach_mm[hits.pixel]]] = False
        return lacking

    def _points(self, seen: Comparison, pixel: np.ndarray) -> np.ndarray:
        """What pixels [N] measured, in the local frame, float32 [N, 3]."""
        T_local_camera = self._surface.to_local(seen.view.T_world_camera)
        directions = self._camera.pixel_directions.reshape(-1, 3)[pixel].astype(np.float64)
        points = (directions * seen.view.distance_mm.reshape(-1)[pixel, None]) @ T_local_camera[:3, :3].T
        return (points + T_local_camera[:3, 3]).astype(np.float32)

    def _welded(self, points: np.ndarray, triangle: np.ndarray) -> np.ndarray:
        """Vertex numbers of ``points`` [N, 3]: the nearest vertex of the triangle [N] they lie on (-1:
        none), or a new one."""
        corners = self._surface.triangles[triangle]
        gap_mm = np.linalg.norm(self._surface.vertices_mm[corners] - points[:, None], axis=2)
        nearest = gap_mm.argmin(axis=1)[:, None]
        weld = (triangle >= 0) & (np.take_along_axis(gap_mm, nearest, axis=1)[:, 0] <= self._weld_mm)
        number = np.take_along_axis(corners, nearest, axis=1)[:, 0].astype(np.int32)
        number[~weld] = len(self.vertices_mm) + np.arange((~weld).sum())
        self.vertices_mm = np.concatenate([self.vertices_mm, points[~weld]])
        return number


def _smooth_quads(distance_mm: np.ndarray, wanted: np.ndarray, allowed_mm: np.ndarray) -> np.ndarray:
    """Row-major pixels [Q, 4] (a b / c d) of 2×2 neighbours with any in ``wanted`` and no step beyond the
    tolerances."""

    height, width = distance_mm.shape
    square = np.ones((2, 2), np.uint8)
    any_wanted = cv2.dilate(wanted.reshape(height, width).view(np.uint8), square, anchor=(0, 0))
    row, column = np.nonzero(any_wanted[:-1, :-1])
    pixel = (row * width + column)[:, None] + np.array([0, 1, width, width + 1])
    near = distance_mm.reshape(-1)[pixel]
    with np.errstate(invalid="ignore"):
        smooth = np.ptp(near, axis=1) <= 2 * allowed_mm[pixel[:, 0]]
    return pixel[smooth]

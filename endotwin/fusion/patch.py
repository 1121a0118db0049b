"""Rays decide what is missing: where a measured pixel misses the surface, that view's own depth is
triangulated, and sewn to the rims of what is there."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from endotwin.cameras import Camera
from endotwin.fusion.agreement import Comparison
from endotwin.fusion.mesh import boundary_edges, proper
from endotwin.fusion.refine import LEAST_COSINE
from endotwin.surface.casting import Caster

LEAST_CROWD = 3
"""A pixel that sees through is patched when this many of the nine there lack a surface; fewer is noise."""

REACH_PX = 2.0
"""A patch joins its pixels to what is there over at most so many pixels."""

SUBDIVISIONS = 64
"""Of a pixel, at which points are triangulated: OpenCV's tests are exact there."""


@dataclass(frozen=True)
class _Points:
    """Vertices as one view sees them, N of them.

    Attributes:
        vertex: int [N], numbers. uv: float64 [N, 2], pixel coordinates. distance_mm: float32 [N], from the
            lens. allowed_mm: float32 [N], tolerance of the distance.
    """

    vertex: np.ndarray
    uv: np.ndarray
    distance_mm: np.ndarray
    allowed_mm: np.ndarray

    def __add__(self, other: _Points) -> _Points:
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return _Points(*(np.concatenate(pair) for pair in pairs))


class Patches:
    """Patches of a caster's surface, made view by view, each only where no earlier one explains the pixel.

    Vertex numbers continue those of the surface, whose rims the patches share.
    """

    def __init__(self, camera: Camera, caster: Caster):
        self._camera = camera
        self._base = caster
        self._surface = caster.surface
        self.vertices_mm = self._surface.vertices_mm
        self._rim = np.unique(boundary_edges(self._surface.triangles))
        self._scenes: list[Caster] = []

    @property
    def triangles(self) -> np.ndarray:
        """Vertex numbers of all patches so far, int32 [P, 3]."""
        none = np.zeros((0, 3), np.int32)
        return np.concatenate([none, *(scene.surface.triangles for scene in self._scenes)])

    def add(self, seen: Comparison) -> None:
        """Triangulate, in the image, the pixels that lack a surface and what is there beside them, where
        distances do not jump; but nothing that would lie on what is there."""
        lacking, triangle = self._unexplained(seen)
        if not lacking.any():
            return
        there = self._pixels_beside(seen, lacking, triangle) + self._rims_beside(seen, lacking)
        points = self._added(seen, np.flatnonzero(lacking)) + there
        new = np.arange(len(points.uv)) < lacking.sum()
        corners = _triangulated(points, new)
        covered = ~new[corners].all(axis=1)
        covered[covered] = self._explained(seen, points, corners[covered])
        triangles = points.vertex[corners[~covered]].astype(np.int32)
        self._rim = np.r_[self._rim, np.unique(boundary_edges(triangles))]
        self._remember(triangles)

    def _remember(self, triangles: np.ndarray) -> None:
        """Add triangles [N, 3] to the scenes.

        Each scene is larger than the next, so that there are few, and few of them are built of any triangle.
        """
        while self._scenes and len(self._scenes[-1].surface.triangles) <= len(triangles):
            triangles = np.concatenate([self._scenes.pop().surface.triangles, triangles])
        if len(triangles):
            patches = replace(self._surface, vertices_mm=self.vertices_mm, triangles=triangles)
            self._scenes.append(Caster(patches))

    def _unexplained(self, seen: Comparison) -> tuple[np.ndarray, np.ndarray]:
        """Bool [H·W]: pixels that lack a surface and that no patch lies at or in front of; and int32 [H·W],
        the triangle that each of the others lies on (those of patches counted on from the surface's), or
        -1."""
        shape = seen.view.distance_mm.shape
        crowd = cv2.boxFilter(seen.lacking.reshape(shape).astype(np.float32), -1, (3, 3), normalize=False)
        lacking = seen.lacking & ((seen.triangle < 0) | (crowd.reshape(-1) >= LEAST_CROWD))
        triangle = np.where(seen.at, seen.triangle, -1)
        first = len(self._surface.triangles)
        for scene in self._scenes:
            hits = scene.cast(self._camera, seen.view.T_world_camera, lacking.reshape(shape))
            behind_mm = hits.distance_mm - seen.view.distance_mm.reshape(-1)[hits.pixel]
            allowed_mm = seen.allowed_mm[hits.pixel]
            lacking[hits.pixel[behind_mm <= allowed_mm]] = False
            at = np.abs(behind_mm) <= allowed_mm
            triangle[hits.pixel[at]] = first + hits.triangle[at]
            first += len(scene.surface.triangles)
        return lacking, triangle

    def _explained(self, seen: Comparison, points: _Points, corners: np.ndarray) -> np.ndarray:
        """Bool [T]: triangles with ``corners`` [T, 3] at or behind whose middle there is surface or patch."""
        lens_mm = self._surface.to_local(seen.view.T_world_camera)[:3, 3].astype(np.float32)
        ray_mm = self.vertices_mm[points.vertex[corners]].mean(axis=1) - lens_mm
        distance_mm = np.linalg.norm(ray_mm, axis=1)
        origins, directions = np.broadcast_to(lens_mm, ray_mm.shape), ray_mm / distance_mm[:, None]
        length_mm = distance_mm + points.allowed_mm[corners[:, 0]]
        clear = [scene.unobstructed(origins, directions, length_mm) for scene in (self._base, *self._scenes)]
        return ~np.all(clear, axis=0)

    def _added(self, seen: Comparison, pixel: np.ndarray) -> _Points:
        """New vertices where pixels [N] measured."""
        first = len(self.vertices_mm)
        self.vertices_mm = np.concatenate([self.vertices_mm, self._measured_mm(seen, pixel)])
        return self._at_pixels(seen, pixel, np.arange(first, len(self.vertices_mm)))

    def _pixels_beside(self, seen: Comparison, lacking: np.ndarray, triangle: np.ndarray) -> _Points:
        """For pixels beside ``lacking`` ones, the nearest vertex of the ``triangle`` that they lie on."""
        beside = cv2.dilate(lacking.reshape(seen.view.distance_mm.shape).view(np.uint8), np.ones((3, 3)))
        pixel = np.flatnonzero((beside.reshape(-1) > 0) & ~lacking & (triangle >= 0))
        number, count = triangle[pixel], len(self._surface.triangles)
        on = self._surface.triangles[np.minimum(number, count - 1)]
        on[number >= count] = self.triangles[number[number >= count] - count]
        apart_mm = self.vertices_mm[on] - self._measured_mm(seen, pixel)[:, None]
        nearest = (apart_mm**2).sum(axis=2).argmin(axis=1)
        return self._at_pixels(seen, pixel, on[np.arange(len(on)), nearest])

    def _at_pixels(self, seen: Comparison, pixel: np.ndarray, vertex: np.ndarray) -> _Points:
        v, u = np.divmod(pixel, self._camera.width)
        distance_mm = seen.view.distance_mm.reshape(-1)[pixel]
        return _Points(
            vertex, np.stack([u, v], axis=1).astype(np.float64), distance_mm, seen.allowed_mm[pixel]
        )

    def _measured_mm(self, seen: Comparison, pixel: np.ndarray) -> np.ndarray:
        """What pixels [N] measured, in the local frame, float32 [N, 3]."""
        T_local_camera = self._surface.to_local(seen.view.T_world_camera)
        directions = self._camera.pixel_directions.reshape(-1, 3)[pixel].astype(np.float64)
        points = (directions * seen.view.distance_mm.reshape(-1)[pixel, None]) @ T_local_camera[:3, :3].T
        return (points + T_local_camera[:3, 3]).astype(np.float32)

    def _rims_beside(self, seen: Comparison, lacking: np.ndarray) -> _Points:
        """Vertices on rims near ``lacking`` pixels that lie where one of the four pixels about them
        measured."""
        height, width = seen.view.distance_mm.shape
        T_local_camera = self._surface.to_local(seen.view.T_world_camera).astype(np.float32)
        ray_mm = self.vertices_mm[self._rim] - T_local_camera[:3, 3]
        uv = self._camera.project(np.einsum("va,ab->vb", ray_mm, T_local_camera[:3, :3]))
        with np.errstate(invalid="ignore"):
            inside = np.flatnonzero(((uv >= 0) & (uv < (width - 1, height - 1))).all(axis=1))
        near = cv2.dilate(lacking.reshape(height, width).view(np.uint8), np.ones((5, 5)))
        u, v = np.rint(uv[inside]).astype(np.int32).T
        inside = inside[near[v, u] > 0]
        inside = inside[self._faces(self._rim[inside], ray_mm[inside])]
        distance_mm = np.linalg.norm(ray_mm[inside], axis=1)
        u, v = uv[inside].astype(np.int32).T
        about = (v * width + u)[:, None] + np.array([0, 1, width, width + 1])
        gap_mm = np.abs(seen.view.distance_mm.reshape(-1)[about] - distance_mm[:, None])
        best = np.nan_to_num(gap_mm, nan=np.inf).argmin(axis=1)
        rows = np.arange(len(best))
        allowed_mm = seen.allowed_mm[about[rows, best]]
        at = np.flatnonzero(gap_mm[rows, best] <= allowed_mm)
        return _Points(self._rim[inside[at]], uv[inside[at]], distance_mm[at], allowed_mm[at])

    def _faces(self, vertex: np.ndarray, ray_mm: np.ndarray) -> np.ndarray:
        """Bool [N]: vertices [N] that a ray [N, 3] to each meets from the front; those of patches always."""
        faces = np.ones(len(vertex), bool)
        own = np.flatnonzero(vertex < len(self._surface.normals))
        along_mm = np.einsum("va,va->v", ray_mm[own], self._surface.normals[vertex[own]])
        faces[own] = -along_mm > LEAST_COSINE * np.linalg.norm(ray_mm[own], axis=1)
        return faces


def _triangulated(points: _Points, new: np.ndarray) -> np.ndarray:
    """Delaunay triangles [T, 3] of the points in the image, facing the lens, without jumps of distance and
    without edges longer than REACH_PX (twice that where neither end is ``new`` [N])."""
    corners = _delaunay(points.uv)
    following = np.roll(corners, -1, axis=1)
    length_px = np.hypot(*(points.uv[corners] - points.uv[following]).transpose(2, 0, 1))
    short = length_px <= REACH_PX * np.where(new[corners] | new[following], 1, 2)
    jump_mm = np.ptp(points.distance_mm[corners], axis=1)
    smooth = jump_mm <= 2 * points.allowed_mm[corners].min(axis=1)
    return corners[short.all(axis=1) & smooth & proper(points.vertex[corners])]


def _delaunay(uv: np.ndarray) -> np.ndarray:
    """Delaunay triangles [T, 3] of pixel coordinates [N, 2] >= 0, seen clockwise with y up.

    On grids OpenCV takes a sixth of Qhull's time. It needs coordinates that are not almost the same, and
    names corners by them, so that they are found again by their bits. Slivers along the convex hull may be
    missing.
    """
    uv = (np.rint(uv * SUBDIVISIONS) / SUBDIVISIONS).astype(np.float32) + np.float32(0)  # no -0
    width, height = np.ceil(uv.max(axis=0)).astype(int) + 2
    plane = cv2.Subdiv2D((-1, -1, int(width) + 1, int(height) + 1))
    plane.insert(uv.tolist())
    triangles = np.array(plane.getTriangleList(), np.float32).reshape(-1, 3, 2)  # () where all are in line
    found = np.ascontiguousarray(triangles[:, ::-1]).view(np.int64)[..., 0]
    bits = np.ascontiguousarray(uv).view(np.int64)[:, 0]
    order = np.argsort(bits, kind="stable")
    place = np.minimum(np.searchsorted(bits[order], found), len(bits) - 1)
    corners = order[place]
    return corners[(bits[corners] == found).all(axis=1)]

"""A surface given as a grid of points that closes on itself from the last column to the first.

A place on it is (row, column), as real numbers: maps over the surface are images in these coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh

BIAS = 1e-3
"""A point is in shadow of what lies nearer than its distance less this share: facets shade themselves not."""


@dataclass(frozen=True)
class Hits:
    """Where N rays meet a wall.

    Attributes:
        rays: int [N], numbers of the rays that hit. points_mm, normals: [N, 3], normals interpolated between
            vertices. place: [N, 2], row and column. All
            float32.
    """

    rays: np.ndarray
    points_mm: np.ndarray
    normals: np.ndarray
    place: np.ndarray


class Wall:
    """The surface of ``points_mm`` [M, N, 3]; each quad is two triangles, and normals point to their front.

    Rows go forward, columns counter-clockwise about that: then the front is inside.
    """

    def __init__(self, points_mm: np.ndarray):
        self.shape = points_mm.shape[:2]
        self.vertices_mm = np.ascontiguousarray(points_mm.reshape(-1, 3), np.float32)
        corner = np.arange(len(self.vertices_mm)).reshape(self.shape)
        right = np.roll(corner, -1, axis=1)
        a, b, c, d = corner[:-1], right[:-1], corner[1:], right[1:]
        self.triangles = np.stack([np.stack([a, c, b], -1), np.stack([d, b, c], -1)], axis=2).reshape(-1, 3)
        self._scene = rtcore_scene.EmbreeScene(robust=True)
        self._mesh = TriangleMesh(self._scene, self.vertices_mm[self.triangles])

    @cached_property
    def doubled_area(self) -> np.ndarray:
        """Vectors [T, 3] along the triangles' normals, twice their area long; triangle 2·quad + half."""
        a, b, c = (self.vertices_mm[self.triangles[:, k]].astype(np.float64) for k in range(3))
        return np.cross(b - a, c - a)

    @cached_property
    def normals(self) -> np.ndarray:
        """Unit normals float32 [V, 3] of the vertices: of the triangles about each, weighted by area."""
        corners = self.triangles.T.ravel()
        sums = [
            np.bincount(corners, np.tile(self.doubled_area[:, k], 3), len(self.vertices_mm)) for k in range(3)
        ]
        return unit(np.stack(sums, axis=1)).astype(np.float32)

    def cast(self, origin_mm: np.ndarray, directions: np.ndarray) -> Hits:
        """First hits of unit rays [N, 3] from ``origin_mm`` [3] or [N, 3]."""
        towards = np.ascontiguousarray(directions, np.float32)
        start = np.ascontiguousarray(np.broadcast_to(origin_mm, towards.shape), np.float32)
        found = self._scene.run(start, towards, output=True)
        rays = np.flatnonzero(found["primID"] >= 0)
        triangle, u, v = found["primID"][rays], found["u"][rays], found["v"][rays]
        weights = np.stack([1 - u - v, u, v], axis=1)
        normals = self._mixed(self.normals, triangle, weights)
        return Hits(
            rays, self._mixed(self.vertices_mm, triangle, weights), unit(normals), self._place(triangle, u, v)
        )

    def hit_triangle(self, origins_mm: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """First triangle int [N] that rays [N, 3] meet; −1: none."""
        origins, towards = (np.ascontiguousarray(x, np.float32) for x in (origins_mm, directions))
        return self._scene.run(origins, towards, query="INTERSECT")

    def sees(self, source_mm: np.ndarray, points_mm: np.ndarray) -> np.ndarray:
        """Bool [N]: whether nothing stands between ``source_mm`` [3] and each of the wall's points [N, 3]."""
        ray = np.ascontiguousarray(points_mm - source_mm, np.float32)
        start = np.ascontiguousarray(np.broadcast_to(source_mm, ray.shape), np.float32)
        reach = np.full(len(ray), 1 - BIAS, np.float32)
        return self._scene.run(start, ray, dists=reach, query="OCCLUDED") < 0

    def _mixed(self, per_vertex: np.ndarray, triangle: np.ndarray, weights: np.ndarray) -> np.ndarray:
        corners = self.triangles[triangle]
        return sum(weights[:, k, None] * per_vertex[corners[:, k]] for k in range(3))

    def _place(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        quad, second = np.divmod(triangle, 2)
        row, column = np.divmod(quad, self.shape[1])
        return np.stack(
            [row + np.where(second, 1 - u, u), column + np.where(second, 1 - v, v)], axis=1
        ).astype(np.float32)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors [..., 3] scaled to length 1; zero stays zero."""
    return vectors / np.maximum(np.sqrt((vectors * vectors).sum(axis=-1, keepdims=True)), 1e-20)


def about(normals: np.ndarray, cos: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Directions [N, 3] at angles of cosine ``cos`` [N] to unit normals, ``turn`` [N] of 1 around them,
    in the basis of Duff et al. 2017."""
    radius, angle = np.sqrt(1 - cos * cos), 2 * np.pi * turn
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    sign = np.where(normals[:, 2] < 0, -1, 1)
    a = -1 / (sign + normals[:, 2])
    b = normals[:, 0] * normals[:, 1] * a
    first = np.stack([1 + sign * normals[:, 0] ** 2 * a, sign * b, -sign * normals[:, 0]], axis=1)
    second = np.stack([b, sign + normals[:, 1] ** 2 * a, -normals[:, 1]], axis=1)
    return x[:, None] * first + y[:, None] * second + cos[:, None] * normals


def sampled(image: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Values [N, C] of an image [H, W, C] at (row, column) [N, 2], bilinear; columns wrap, rows end."""
    height, width = image.shape[:2]
    row = np.clip(place[:, 0], 0, height - 1)
    top = np.minimum(row.astype(np.int32), height - 2)
    left = np.floor(place[:, 1]).astype(np.int32)
    down, aside = (row - top)[:, None], (place[:, 1] - left)[:, None]
    left, right = left % width, (left + 1) % width
    flat = image.reshape(height * width, -1)
    start = top * width
    upper = (1 - aside) * flat[start + left] + aside * flat[start + right]
    lower = (1 - aside) * flat[start + width + left] + aside * flat[start + width + right]
    return (1 - down) * upper + down * lower

"""What a pose sees of the lumen: whether it lies inside the surface and looks at it, and how near it is."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from endotwin.cameras import Camera
from endotwin.surface import Surface
from endotwin.surface.casting import Caster
from endotwin.surface.vectors import unit

FRONT_MIN = 0.3
"""Least share of the view that sees the wall from the lumen."""

BACK_MAX = 0.2
"""Greatest share of the view that sees the wall from behind."""

VIEW_GRID = 24
SPHERE_RAYS = 512
POSES_PER_BATCH = 256


@dataclass(frozen=True)
class Outlook:
    """What N poses see.

    Attributes:
        front: float64 [N], share of the view whose rays meet the wall on its lumen side.
        back: float64 [N], share whose rays meet it from behind.
        clearance_mm: float64 [N], distance to the nearest wall in any direction; inf where there is none.
        unseen: float64 [N], share of the view whose surface was measured, but seen by no training photo.
        filled: float64 [N], share of the view whose surface was filled in.
    """

    front: np.ndarray
    back: np.ndarray
    clearance_mm: np.ndarray
    unseen: np.ndarray
    filled: np.ndarray

    @property
    def empty(self) -> np.ndarray:
        """Float64 [N], share of the view that meets no surface."""
        return 1 - self.front - self.back

    @property
    def inside(self) -> np.ndarray:
        """Bool [N]: poses inside the surface that look at its wall."""
        return (self.front >= FRONT_MIN) & (self.back <= BACK_MAX) & (self.clearance_mm > 0)


class Lumen:
    """The space that a surface encloses, probed by rays."""

    def __init__(self, surface: Surface):
        self.surface = surface
        a, b, c = (surface.vertices_mm[surface.triangles[:, k]] for k in range(3))
        self._facing = unit(np.cross(b - a, c - a))
        self._sphere = fibonacci_sphere(SPHERE_RAYS)
        self._filled = surface.filled[surface.triangles].any(axis=1)
        self._unseen = ~surface.seen() & ~self._filled & surface.seen_by.any()

    @cached_property
    def _caster(self) -> Caster:
        return Caster(self.surface)

    def probe(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """First hits of rays in the surface's local frame.

        Args:
            origins: [N, 3]; directions: unit, [N, M, 3].

        Returns:
            distance_mm float32 [N, M] and triangle int32 [N, M], inf and -1 where nothing is hit, and front
            bool [N, M], true where the lumen side is hit.
        """
        shape = directions.shape[:2]
        rays = np.ascontiguousarray(directions, np.float32).reshape(-1, 3)
        starts = np.repeat(np.asarray(origins, np.float32), shape[1], axis=0)
        triangle, _, distance_mm = self._caster.cast_rays(starts, rays)
        front = (triangle >= 0) & (np.einsum("nk,nk->n", rays, self._facing[triangle]) < 0)
        return distance_mm.reshape(shape), triangle.reshape(shape), front.reshape(shape)

    def outlook(self, camera: Camera, T_world_camera: np.ndarray) -> Outlook:
        """What the poses [N, 4, 4] see through ``camera``."""
        poses = np.asarray(T_world_camera, np.float64)
        seen = [
            self._outlook(camera, poses[start : start + POSES_PER_BATCH])
            for start in range(0, len(poses), POSES_PER_BATCH)
        ]
        return Outlook(*np.concatenate(seen, axis=1))

    def _outlook(self, camera: Camera, poses: np.ndarray) -> np.ndarray:
        """The fields of Outlook for a batch of poses [N, 4, 4], float64 [5, N]."""
        origins = poses[:, :3, 3] - self.surface.origin_mm
        view = np.einsum("nij,mj->nmi", poses[:, :3, :3], view_directions(camera))
        _, triangle, front = self.probe(origins, view)
        around, _, _ = self.probe(origins, np.broadcast_to(self._sphere, (len(poses), *self._sphere.shape)))
        hit = triangle >= 0
        unseen, filled = (hit & kind[triangle] for kind in (self._unseen, self._filled))
        return np.stack(
            [front.mean(1), (hit & ~front).mean(1), around.min(1), unseen.mean(1), filled.mean(1)]
        )


def view_directions(camera: Camera) -> np.ndarray:
    """A coarse grid of the camera's viewing directions, unit, float64 [M, 3]."""
    u, v = np.meshgrid(
        np.linspace(0, camera.width - 1, VIEW_GRID), np.linspace(0, camera.height - 1, VIEW_GRID)
    )
    directions = camera.directions(np.stack([u, v], axis=-1)).reshape(-1, 3)
    return directions[np.isfinite(directions).all(axis=1)]


def fibonacci_sphere(count: int) -> np.ndarray:
    """``count`` nearly even directions, unit, float64 [count, 3]."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    azimuth = np.pi * (1 + np.sqrt(5)) * k
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=1)

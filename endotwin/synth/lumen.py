"""What a pose sees of the lumen: whether it lies inside the surface, clear of the wall, looking at it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from endotwin.cameras import Camera
from endotwin.casting import Caster
from endotwin.incidence import unit
from endotwin.surface import Surface

CLEARANCE_MIN_MM = 1.0
"""Least distance from the camera centre to the wall."""

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
    """

    front: np.ndarray
    back: np.ndarray
    clearance_mm: np.ndarray

    @property
    def inside(self) -> np.ndarray:
        """Bool [N]: poses that can be rendered."""
        return (self.front >= FRONT_MIN) & (self.back <= BACK_MAX) & (self.clearance_mm >= CLEARANCE_MIN_MM)

    def fault(self, index: int) -> str:
        """What is wrong with a pose that is not ``inside``, as the end of a sentence."""
        if self.front[index] >= FRONT_MIN and self.back[index] <= BACK_MAX:
            return f"is {self.clearance_mm[index]:.2f} mm from the wall (least: {CLEARANCE_MIN_MM:g} mm)"
        return (
            f"lies outside the surface or looks away from it: {self.front[index]:.0%} of its view meets the "
            f"lumen's wall, {self.back[index]:.0%} the wall's back"
        )


class Lumen:
    """The space that a surface encloses, probed by rays."""

    def __init__(self, surface: Surface):
        self.surface = surface
        self._caster = Caster(surface)
        a, b, c = (surface.vertices_mm[surface.triangles[:, k]] for k in range(3))
        self._facing = unit(np.cross(b - a, c - a))
        self._sphere = fibonacci_sphere(SPHERE_RAYS)

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
        """Front, back and clearance of a batch of poses [N, 4, 4], float64 [3, N]."""
        origins = poses[:, :3, 3] - self.surface.origin_mm
        view = np.einsum("nij,mj->nmi", poses[:, :3, :3], view_directions(camera))
        _, triangle, front = self.probe(origins, view)
        around, _, _ = self.probe(origins, np.broadcast_to(self._sphere, (len(poses), *self._sphere.shape)))
        return np.stack([front.mean(1), ((triangle >= 0) & ~front).mean(1), around.min(1)])


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

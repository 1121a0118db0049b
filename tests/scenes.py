"""Scenes with a known surface, seen from inside, written as sequences by means that share nothing with
endotwin's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from endotwin.cameras import Camera, Omni, Pinhole
from endotwin.sequence import Sequence

FARTHEST_MM = 100.0
ALMOST_MM = 1e-4


@dataclass(frozen=True)
class Scene:
    """A lumen: the points where ``height`` is negative; ``height`` grows about as fast as the distance."""

    height: Callable[[np.ndarray], np.ndarray]

    def off_surface_mm(self, points: np.ndarray) -> np.ndarray:
        """Distance of points [N, 3] from the surface, to first order: |height| / |∇height|."""
        return np.abs(self.height(points)) / np.linalg.norm(self.gradient(points), axis=1)

    def gradient(self, points: np.ndarray) -> np.ndarray:
        """∇height [N, 3] by central differences; it points out of the lumen."""
        steps = 1e-4 * np.eye(3)
        return np.stack([self.height(points + h) - self.height(points - h) for h in steps], axis=-1) / 2e-4

    def distance_mm(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Distance [N] along unit rays [N, 3] from ``origin`` [3] to the surface; NaN beyond
        ``FARTHEST_MM``."""
        t = np.zeros(len(directions))
        on_the_way = np.arange(len(directions))
        for _ in range(150):
            left = self.height(origin + t[on_the_way, None] * directions[on_the_way])
            on_the_way, left = on_the_way[left < -ALMOST_MM], left[left < -ALMOST_MM]
            t[on_the_way] = np.minimum(t[on_the_way] - 0.6 * left, 2 * FARTHEST_MM)
        ahead = t + 0.5
        for _ in range(25):
            middle = (t + ahead) / 2
            inside = self.height(origin + middle[:, None] * directions) < 0
            t, ahead = np.where(inside, middle, t), np.where(inside, ahead, middle)
        return np.where(t < FARTHEST_MM, t, np.nan)

    def render(self, camera: Camera, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Photo uint8 [H, W, 3] under a light at the lens, and z-depth float32 [H, W], NaN where there is
        none."""
        directions = camera.pixel_directions.reshape(-1, 3).astype(np.float64)
        seen = np.flatnonzero(np.isfinite(directions).all(axis=1))
        world = directions[seen] @ T_world_camera[:3, :3].T
        distance_mm = np.full(len(directions), np.nan)
        distance_mm[seen] = self.distance_mm(T_world_camera[:3, 3], world)
        points = T_world_camera[:3, 3] + distance_mm[seen, None] * world
        outward = self.gradient(points)
        cosine = np.einsum("na,na->n", outward, world) / np.linalg.norm(outward, axis=1)
        forward = np.maximum(directions[seen, 2], 0)
        light = np.zeros(len(directions))
        light[seen] = np.nan_to_num(150 * forward**2 * cosine / distance_mm[seen] ** 2)
        grey = np.clip(255 * np.clip(light, 0, 1) ** (1 / 2.2), 8, 255).reshape(camera.height, camera.width)
        depth_mm = np.where(directions[:, 2] > 0, distance_mm * directions[:, 2], np.nan)
        photo = np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)
        return photo, depth_mm.astype(np.float32).reshape(camera.height, camera.width)

    def sequence(
        self, folder: Path, camera: Camera, T_world_camera: np.ndarray, shift_mm: float = 0.0
    ) -> Sequence:
        """Photos and depth of poses [N, 4, 4] in ``folder``; the world is moved by ``shift_mm`` along each
        axis."""
        folder.mkdir(parents=True, exist_ok=True)
        for index, T in enumerate(T_world_camera):
            photo, depth_mm = self.render(camera, T)
            cv2.imwrite(str(folder / f"{index:04d}.png"), photo)
            np.save(folder / f"{index:04d}.npy", depth_mm)
        moved = np.array(T_world_camera, np.float64)
        moved[:, :3, 3] += shift_mm
        count = range(len(moved))
        return Sequence(
            path=folder,
            format="scene",
            camera=camera,
            T_world_camera=moved,
            color_files=tuple(folder / f"{index:04d}.png" for index in count),
            depth_files=tuple(folder / f"{index:04d}.npy" for index in count),
            read_depth_mm=np.load,
            timestamps_s=np.arange(len(moved), dtype=np.float64),
        )


def sphere(radius_mm: float = 15.0) -> Scene:
    """A sphere about the origin."""
    return Scene(lambda p: np.linalg.norm(p, axis=-1) - radius_mm)


def cylinder(radius_mm: float = 12.0) -> Scene:
    """An open cylinder along z."""
    return Scene(lambda p: np.hypot(p[..., 0], p[..., 1]) - radius_mm)


def bumpy_tube(radius_mm: float = 12.0, length_mm: float = 45.0) -> Scene:
    """A tube along z with ring-like folds of uneven height, closed at both ends."""

    def height(p: np.ndarray) -> np.ndarray:
        angle = np.arctan2(p[..., 1], p[..., 0])
        fold = 1.2 * np.cos(2 * np.pi * p[..., 2] / 14) * (1 + 0.4 * np.cos(3 * angle))
        side = np.hypot(p[..., 0], p[..., 1]) - radius_mm - fold
        return np.maximum(side, np.abs(p[..., 2]) - length_mm)

    return Scene(height)


def pinhole(width: int = 160, height: int = 120) -> Pinhole:
    """A pinhole of 90° across."""
    return Pinhole(width, height, width / 2, width / 2, (width - 1) / 2, (height - 1) / 2)


def omni(width: int = 170, height: int = 136) -> Omni:
    """C3VD's lens, whose field passes 180° in the corners, at an eighth of its resolution."""
    from endotwin.cameras import CALIBRATIONS

    return CALIBRATIONS["c3vd-v1"].scaled(width / 1350)


def look(origin: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """The pose [4, 4] at ``origin`` [3] that looks along ``towards`` [3]."""
    z = np.asarray(towards, np.float64) / np.linalg.norm(towards)
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    T_world_camera = np.eye(4)
    T_world_camera[:3] = np.stack([x, np.cross(z, x), z, origin], axis=1)
    return T_world_camera


def poses_all_round(radius_mm: float = 3.0) -> np.ndarray:
    """Six poses [6, 4, 4] near the origin, one a direction of the axes."""
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    return np.stack([look(-radius_mm * axis, axis) for axis in axes])


def poses_along(count: int = 8, start_mm: float = -30.0, stop_mm: float = 0.0) -> np.ndarray:
    """Poses [count, 4, 4] along z, looking ahead and a little to the side."""
    wave = np.linspace(0, 2 * np.pi, count)
    ways = zip(np.linspace(start_mm, stop_mm, count), wave, strict=True)
    return np.stack([look((2 * np.cos(a), 2 * np.sin(a), z), (0.15 * np.sin(a), 0.15, 1)) for z, a in ways])

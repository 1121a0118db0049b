"""A closed, painted cylinder, photographed in closed form: the scene of the checks that need a sequence.

The wall is Lambertian, the light at the lens L0·cos²θ/d², the response x^(1/2.2). Nothing here shares code
with what it checks.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

GAMMA, CONE, FALLOFF = 1 / 2.2, 2.0, 2.0
ASPECT = 0.75
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])

Damage = Callable[[int, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Tube:
    """The scene and how it is photographed.

    Attributes:
        radius_mm, far_mm: radius, and where the far end is (inf: there is none).
        width: of the photos, in pixels; the field of view is 80° across.
        light: L0, at 1 mm before ``scale``.
        scale: factor on every length of the scene and of the poses.
        shift_mm: added to every coordinate of the world.
    """

    radius_mm: float = 10.0
    far_mm: float = 45.0
    width: int = 64
    light: float = 40.0
    scale: float = 1.0
    shift_mm: float = 0.0

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the photos."""
        return round(self.width * ASPECT), self.width

    @property
    def rays(self) -> np.ndarray:
        """Unit viewing directions in the camera frame, float64 [H, W, 3]."""
        height, width = self.size
        u, v = np.meshgrid(np.arange(width) - (width - 1) / 2, np.arange(height) - (height - 1) / 2)
        rays = np.stack([u, v, np.full(u.shape, 0.6 * width)], axis=-1)
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    def photograph(self, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Photo uint8 [H, W, 3] and z-depth float32 [H, W] of the unscaled scene, NaN where there is no
        wall."""
        rays = self.rays
        world, origin = rays @ T_world_camera[:3, :3].T, T_world_camera[:3, 3]
        across = (world[..., :2] ** 2).sum(axis=-1)
        along = (world[..., :2] * origin[:2]).sum(axis=-1)
        inside = self.radius_mm**2 - (origin[:2] ** 2).sum()
        with np.errstate(divide="ignore", invalid="ignore"):
            wall = (-along + np.sqrt(along**2 + across * inside)) / across
            end = np.where(world[..., 2] > 0, (self.far_mm - origin[2]) / world[..., 2], np.inf)
        distance = np.minimum(wall, end)
        seen = np.isfinite(distance)
        point = origin + np.where(seen, distance, 1)[..., None] * world
        inward = np.where((end < wall)[..., None], [0, 0, -1.0], -point * [1, 1, 0] / self.radius_mm)
        angle = np.arctan2(point[..., 1], point[..., 0])
        wave = 0.5 + 0.25 * np.sin(3 * angle + 0.4 * point[..., 2]) + 0.2 * np.cos(0.9 * point[..., 2])
        light = self.light * rays[..., 2] ** CONE / np.where(seen, distance, np.inf) ** FALLOFF
        radiance = (
            wave[..., None] * [0.8, 0.45, 0.35] * (2 * light * -(inward * world).sum(axis=-1))[..., None]
        )
        photo = np.uint8(np.clip(np.maximum(radiance, 0) ** GAMMA, 0, 1) * 255 + 0.5)
        return photo, np.where(seen, distance * rays[..., 2], np.nan).astype(np.float32)

    def write(self, folder: Path, poses: np.ndarray, damage: Damage | None = None) -> Path:
        """The sequence of ``poses`` [N, 4, 4] as nerfstudio's layout in ``folder``, which is returned.

        ``damage`` may change each photo and depth map (mm, before ``scale``) before it is written.
        """
        (folder / "images").mkdir(parents=True)
        (folder / "depth").mkdir()
        height, width = self.size
        frames = []
        for index, T in enumerate(poses):
            photo, depth_mm = self.photograph(T)
            if damage:
                photo, depth_mm = damage(index, photo, depth_mm)
            cv2.imwrite(str(folder / f"images/{index:04d}.png"), photo[..., ::-1])
            np.save(folder / f"depth/{index:04d}.npy", (depth_mm * self.scale).astype(np.float32))
            T_world_camera = T @ OPENGL
            T_world_camera[:3, 3] = T[:3, 3] * self.scale + self.shift_mm
            frames.append(
                {"file_path": f"images/{index:04d}.png", "transform_matrix": T_world_camera.tolist()}
            )
        camera = {"w": width, "h": height, "fl_x": 0.6 * width, "fl_y": 0.6 * width}
        document = {"unit": "mm", "depth_unit_scale_factor": 1.0, **camera, "frames": frames}
        (folder / "transforms.json").write_text(json.dumps(document), encoding="utf-8")
        return folder


def flight(count: int = 8, step_mm: float = 1.0, sway_mm: float = 1.5) -> np.ndarray:
    """Poses [count, 4, 4] that look along the tube, advancing ``step_mm`` a frame."""
    T = np.tile(np.eye(4), (count, 1, 1))
    for k in range(count):
        turn = np.array([0.1 * np.cos(0.9 * k), 0.12 * np.sin(1.3 * k), 0.05 * k])
        T[k, :3, :3] = cv2.Rodrigues(turn)[0]
        T[k, :3, 3] = sway_mm * np.sin(0.7 * k), 0.8 * sway_mm * np.cos(0.5 * k), step_mm * k
    return T

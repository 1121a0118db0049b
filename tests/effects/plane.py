"""A wall that faces the camera, and what a moving camera's film records of it, in closed form."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch

from endotwin.cameras import Pinhole

CAMERA = Pinhole(120, 80, 100.0, 100.0, 59.5, 39.5)
DEPTH_MM = 20.0


@dataclass
class Plane:
    """The wall z = DEPTH_MM with a radiance of x and y in mm; it counts what it renders.

    Outside the mask its film is NaN.
    """

    radiance: Callable[[np.ndarray, np.ndarray], np.ndarray]
    pixels: int = 0
    poses: list[np.ndarray] = field(default_factory=list)

    def film(self, T_world_camera: np.ndarray, mask: np.ndarray | None) -> torch.Tensor:
        rays = CAMERA.pixel_directions.astype(np.float64) @ T_world_camera[:3, :3].T
        distance = (DEPTH_MM - T_world_camera[2, 3]) / rays[..., 2]
        point = T_world_camera[:3, 3] + distance[..., None] * rays
        image = self.radiance(point[..., 0], point[..., 1])
        self.poses.append(T_world_camera)
        self.pixels += image.size if mask is None else int(mask.sum())
        if mask is not None:
            image = np.where(mask, image, np.nan)
        return torch.from_numpy(np.repeat(image[..., None], 3, axis=2).astype(np.float32))


def moved(x_mm: float = 0.0, y_mm: float = 0.0, z_mm: float = 0.0) -> np.ndarray:
    """The pose [4, 4] moved from the origin."""
    T_world_camera = np.eye(4)
    T_world_camera[:3, 3] = x_mm, y_mm, z_mm
    return T_world_camera


def depth() -> np.ndarray:
    """Depth float32 [H, W] of the wall from the origin."""
    return np.full((CAMERA.height, CAMERA.width), DEPTH_MM, np.float32)


def px(mm: float) -> float:
    """Pixels that the wall moves by for a sideways motion in mm."""
    return CAMERA.fx * mm / DEPTH_MM

"""The optical axis of a camera of any model: where it meets the image, and the focal length there."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from endotwin.cameras import Camera

NEAR_AXIS = 1e-4


@lru_cache(maxsize=16)
def principal_point_px(camera: Camera) -> tuple[float, float]:
    """Pixel coordinates (u, v) that see along the optical axis."""
    u, v = camera.project(np.array([0.0, 0.0, 1.0]))
    return float(u), float(v)


@lru_cache(maxsize=16)
def focal_px(camera: Camera) -> float:
    """Pixels a radian at the axis, the mean of both directions: f of the thin lens, in pixels."""
    beside = np.array([[NEAR_AXIS, 0, 1], [0, NEAR_AXIS, 1]])
    shifts = camera.project(beside) - principal_point_px(camera)
    return float(np.linalg.norm(shifts, axis=1).mean() / NEAR_AXIS)


@lru_cache(maxsize=4)
def angle_from_axis(camera: Camera) -> np.ndarray:
    """Angle in radians between each pixel's ray and the axis, float32 [H, W]; NaN where there is no ray."""
    sideways = np.linalg.norm(camera.pixel_directions[..., :2], axis=2)
    angle = np.arctan2(sideways, camera.pixel_directions[..., 2])
    angle.setflags(write=False)
    return angle

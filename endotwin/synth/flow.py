"""Where a surface point lies in another view, and what hides it: exact, by rays through the mesh."""

from __future__ import annotations

import numpy as np

from endotwin.cameras import Camera
from endotwin.surface.casting import Caster, Correspondences
from endotwin.surface.vectors import dot, unit

HIDDEN_MM = 1e-3
HIDDEN = 1e-4
"""A point is hidden where a ray to it ends more than HIDDEN_MM + HIDDEN·distance before it."""

BEHIND_MM = 0.01
"""How far behind a hit the ray goes on that looks for surface hidden by it."""

OCCLUSION_RANGE_MM = 100.0


def projected(points: np.ndarray, camera: Camera, T_world_camera: np.ndarray) -> np.ndarray:
    """Where points [N, 3] lie in the view from a pose [4, 4], px, float64 [N, 2]; NaN where the lens does not
    see in that direction."""
    return camera.project(to_camera_frame(points, T_world_camera))


def flow_to(uv: np.ndarray, pixel: np.ndarray, camera: Camera) -> np.ndarray:
    """Motion float64 [N, 2], px, of pixels int [N] to places ``uv`` [N, 2] in another view."""
    return uv - np.stack([pixel % camera.width, pixel // camera.width], axis=1)


def seen_from(
    points: np.ndarray, uv: np.ndarray, caster: Caster, camera: Camera, T_world_other: np.ndarray
) -> np.ndarray:
    """Bool [N]: points [N, 3] on the surface, at ``uv`` [N, 2] in the view from ``T_world_other`` [4, 4],
    that it shows."""
    u, v = uv.T
    inside = (u > -0.5) & (u < camera.width - 0.5) & (v > -0.5) & (v < camera.height - 0.5)
    chosen = np.flatnonzero(inside)
    origin = T_world_other[:3, 3]
    towards = points.take(chosen, axis=0) - origin
    distance_mm = np.sqrt(dot(towards, towards))
    local = (origin - caster.surface.origin_mm).astype(np.float32)
    rays = (towards / np.maximum(distance_mm, 1e-9)[:, None]).astype(np.float32)
    length_mm = distance_mm * (1 - HIDDEN) - HIDDEN_MM
    seen = np.zeros(len(points), bool)
    seen[chosen] = caster.unobstructed(np.broadcast_to(local, rays.shape), rays, length_mm)
    return seen


def hides_surface(
    points: np.ndarray, hits: Correspondences, caster: Caster, T_world_camera: np.ndarray
) -> np.ndarray:
    """Bool [N]: points [N, 3] of ``hits`` with more surface behind them on the same ray, within
    OCCLUSION_RANGE_MM of the camera (C3VD's occlusion)."""
    towards = points - T_world_camera[:3, 3]
    rays = unit(towards).astype(np.float32)
    behind = (points - caster.surface.origin_mm).astype(np.float32) + BEHIND_MM * rays
    left_mm = OCCLUSION_RANGE_MM - hits.distance_mm - BEHIND_MM
    return ~caster.unobstructed(behind, rays, left_mm)


def to_camera_frame(points: np.ndarray, T_world_camera: np.ndarray) -> np.ndarray:
    """World points [N, 3] in the frame of the camera at ``T_world_camera`` [4, 4]."""
    return (points - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]

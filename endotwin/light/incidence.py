"""How light and view meet the surface at each hit pixel: all the geometry that shading needs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from endotwin.cameras.base import Camera
from endotwin.surface import Surface
from endotwin.surface.casting import Correspondences
from endotwin.surface.vectors import dot, scaled, unit

COS_MIN = 1e-4
"""Least cosine kept: a surface seen at 89.994° reflects nothing that an 8-bit photo shows, and logarithms
stay finite."""

DISTANCE_MIN_MM = 1e-3


@dataclass(frozen=True)
class Incidence:
    """Geometry of the co-located light (wi = wo = ω) at N hits.

    Attributes:
        cos: float32 [N], n·ω, at least COS_MIN.
        sin2: float32 [N], |n × ω|², exact where cos is close to 1.
        log_cos_axis: float32 [N], ln cosθ, θ between the optical axis and the viewing ray.
        log_distance: float32 [N], ln of the distance in mm.
    """

    cos: np.ndarray
    sin2: np.ndarray
    log_cos_axis: np.ndarray
    log_distance: np.ndarray


def incidence(
    hits: Correspondences, surface: Surface, camera: Camera, T_world_camera: np.ndarray
) -> Incidence:
    """Incidence at ``hits`` of the view from pose ``T_world_camera`` [4, 4], with the light at the lens."""
    normals = to_camera(hits.interpolate(surface, surface.normals), T_world_camera)
    return incidence_on(normals, hits, camera.pixel_directions)


def to_camera(normals: np.ndarray, T_world_camera: np.ndarray) -> np.ndarray:
    """World normals [N, 3] of any length as unit normals in the camera frame of pose [4, 4]."""
    return unit(normals @ T_world_camera[:3, :3].astype(normals.dtype))


def incidence_on(normals: np.ndarray, hits: Correspondences, directions: np.ndarray) -> Incidence:
    """Incidence at ``hits`` with unit ``normals`` [N, 3], seen along unit ``directions`` [..., 3] of all
    pixels, both float32 in the camera frame, light at the lens."""
    view = directions.reshape(-1, 3).take(hits.pixel, axis=0)
    cos = -dot(normals, view)
    # |n × ω|² = |n − cos·ω|² with ω = −view, without the cancellation of 1 − cos².
    tangential = normals + scaled(view, cos)
    return Incidence(
        cos=np.maximum(cos, COS_MIN),
        sin2=dot(tangential, tangential),
        log_cos_axis=np.log(np.maximum(view[:, 2], COS_MIN)),
        log_distance=np.log(np.maximum(hits.distance_mm, DISTANCE_MIN_MM)),
    )

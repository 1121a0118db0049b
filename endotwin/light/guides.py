"""Light guides beside the lens: how each lights a surface point, and what it casts into shadow.

Vocabulary of ``shading``: ``wi`` unit direction to the guide, ``wo`` to the camera, ``wm`` their half vector.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from endotwin.light.incidence import COS_MIN, DISTANCE_MIN_MM
from endotwin.surface.casting import Caster
from endotwin.surface.rows import Rows
from endotwin.surface.vectors import dot, scaled, unit

SHADOW_BIAS = 0.015
"""A point is in shadow where a ray to it ends this share of its length before it: a fold rim throws
shadows from farther away, and the mesh's own facets must throw none."""

COSINE, EXPONENTIAL = 0.0, 1.0
"""Angular shapes of the light: cosⁿθ (Han & Wu 2025), e^{−n(1−cosθ)} (EndoMapper: Azagra et al. 2023). A
profile between them mixes their logarithms."""

AT_LENS = ((0.0, 0.0, 0.0),)


@dataclass(frozen=True)
class Guided(Rows):
    """How K guides light N points.

    Attributes:
        cos_i: n·wi, 0 where the guide is behind the surface or in shadow. sin2_m: |n × wm|². cos_d: wi·wm.
            log_axis: logarithm of the angular shape for exponent 1. log_distance: ln of the distance in mm.
            All float32 [N, K].
    """

    cos_i: Tensor
    sin2_m: Tensor
    cos_d: Tensor
    log_axis: Tensor
    log_distance: Tensor

    def __len__(self) -> int:
        return len(self.cos_i)

    def to(self, device: torch.device) -> Guided:
        """The same on ``device``."""
        return Guided(**{name: value.to(device) for name, value in vars(self).items()})


def log_axis(cos_axis: np.ndarray, profile: float) -> np.ndarray:
    """Logarithm of the light's angular shape for exponent 1, of cosθ at least COS_MIN."""
    if profile == COSINE:
        return np.log(cos_axis)
    return (1 - profile) * np.log(cos_axis) + profile * (cos_axis - 1)


@dataclass(frozen=True)
class Incoming:
    """How light of K guides comes to N points, whatever their normals.

    Attributes:
        wi, wm: [N, 3] of each guide. cos_d, log_axis, log_distance: [N] of each, as in ``Guided``.
    """

    wi: list[np.ndarray]
    wm: list[np.ndarray]
    cos_d: list[np.ndarray]
    log_axis: list[np.ndarray]
    log_distance: list[np.ndarray]

    @classmethod
    def at(cls, points_mm: np.ndarray, guides_mm: np.ndarray, profile: float) -> Incoming:
        """From guides at ``guides_mm`` [K, 3] to ``points_mm`` [N, 3], both in the camera frame; each guide
        shines along the optical axis."""
        found, wo = cls([], [], [], [], []), unit(-points_mm)
        for guide_mm in np.asarray(guides_mm, np.float32):
            towards = guide_mm - points_mm
            distance_mm = np.maximum(np.sqrt(dot(towards, towards)), DISTANCE_MIN_MM)
            wi = towards / distance_mm[:, None]
            wm = unit(wi + wo)
            found.wi.append(wi)
            found.wm.append(wm)
            found.cos_d.append(dot(wi, wm))
            found.log_axis.append(log_axis(np.maximum(-wi[:, 2], COS_MIN), profile))
            found.log_distance.append(np.log(distance_mm))
        return found

    def on(self, normals: np.ndarray, visible: np.ndarray | None = None) -> Guided:
        """On unit ``normals`` [N, 3], camera frame.

        Args:
            visible: [N, K], share of each guide that the point sees; all of it unless given.
        """
        cos_i, sin2_m = [], []
        for k, (wi, wm) in enumerate(zip(self.wi, self.wm, strict=True)):
            across, cos = np.cross(normals, wm), np.maximum(dot(normals, wi), 0)
            cos_i.append(cos if visible is None else cos * visible[:, k])
            sin2_m.append(dot(across, across))
        columns = (cos_i, sin2_m, self.cos_d, self.log_axis, self.log_distance)
        return Guided(*(torch.from_numpy(np.stack(each)).T for each in columns))


def guided(
    points_mm: np.ndarray,
    normals: np.ndarray,
    guides_mm: np.ndarray,
    profile: float,
    visible: np.ndarray | None = None,
) -> Guided:
    """What guides at ``guides_mm`` [K, 3] do to ``points_mm`` [N, 3] with unit ``normals`` [N, 3], of which
    they see as much as ``visible`` [N, K] says."""
    return Incoming.at(points_mm, guides_mm, profile).on(normals, visible)


def visible_from(
    caster: Caster, T_local_camera: np.ndarray, points_mm: np.ndarray, guides_mm: np.ndarray
) -> np.ndarray:
    """Which points [N, 3] (camera frame) each guide [K, 3] sees, float32 [N, K] of 0 and 1.

    ``T_local_camera`` [4, 4] is the view's pose in the surface's local frame.
    """
    rotation, centre = T_local_camera[:3, :3].astype(np.float32), T_local_camera[:3, 3].astype(np.float32)
    seen = np.empty((len(points_mm), len(guides_mm)), np.float32)
    for k, guide_mm in enumerate(np.asarray(guides_mm, np.float32)):
        rays_mm = (points_mm - guide_mm) @ rotation.T
        origins = np.broadcast_to(centre + rotation @ guide_mm, rays_mm.shape)
        seen[:, k] = _sees(caster, origins, rays_mm)
    return seen


def visible_in_views(
    caster: Caster, T_local_camera: np.ndarray, view: np.ndarray, points_mm: np.ndarray, guides_mm: np.ndarray
) -> np.ndarray:
    """Bool [N, K]: which points [N, 3] (surface's frame), each seen in its ``view`` [N] of those with poses
    ``T_local_camera`` [M, 4, 4], guides [K, 3] (camera frame) see; all in one cast."""
    guides_mm = np.asarray(guides_mm)
    rotated_mm = np.einsum("mab,kb->kma", T_local_camera[:, :3, :3], guides_mm)
    local_mm = (rotated_mm + T_local_camera[:, :3, 3]).astype(np.float32)
    origins_mm = local_mm.take(view, axis=1)
    rays_mm = points_mm - origins_mm
    seen = _sees(caster, origins_mm.reshape(-1, 3), rays_mm.reshape(-1, 3))
    return seen.reshape(len(guides_mm), -1).T


def _sees(caster: Caster, origins_mm: np.ndarray, rays_mm: np.ndarray) -> np.ndarray:
    """Bool [N]: whether ``origins_mm`` [N, 3] see the surface at the ends of ``rays_mm`` [N, 3], both in its
    frame."""
    distance_mm = np.maximum(np.sqrt(dot(rays_mm, rays_mm)), DISTANCE_MIN_MM)
    directions = scaled(rays_mm, 1 / distance_mm)
    return caster.unobstructed(origins_mm, directions, distance_mm * (1 - SHADOW_BIAS))


def lamps_mm(guides_mm: Sequence | None) -> np.ndarray:
    """Where light comes from, camera frame, float32 [K, 3]: ``guides_mm`` [K, 3], or the lens (None)."""
    return np.asarray(guides_mm or AT_LENS, np.float32)

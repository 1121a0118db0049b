"""The film of fluid on tissue: what it mirrors of the light guides.

Fluid levels what lies beneath it: its surface has normals of its own, which no depth map tells, and sends
mirror images of the guides to the camera, so sharp that a vertex shines in some views and not in their
neighbours. A film is known where photos showed such a glint, and nowhere else.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from endotwin.light import shading
from endotwin.light.guides import log_axis, visible_from
from endotwin.light.incidence import COS_MIN, DISTANCE_MIN_MM
from endotwin.surface.casting import Caster
from endotwin.surface.vectors import dot, unit


@dataclass(frozen=True, eq=False)
class Film:
    """The film on M vertices of a surface.

    Attributes:
        vertex: int32 [M], ascending. normal: float32 [M, 3], unit normals of the fluid, in the surface's
            frame. weight: float32 [M], share of the mirrored light, 1 for a whole film of water; more where
            guides are brighter than the light that falls on the tissue.
    """

    vertex: np.ndarray
    normal: np.ndarray
    weight: np.ndarray

    def __len__(self) -> int:
        return len(self.vertex)

    def on_all(self, values: np.ndarray, count: int) -> np.ndarray:
        """``values`` [M] or [M, C] on all ``count`` vertices of the surface, float32: 0 where no film is."""
        everywhere = np.zeros((count, *values.shape[1:]), np.float32)
        everywhere[self.vertex] = values
        return everywhere

    def wets(self, triangles: np.ndarray) -> np.ndarray:
        """Bool [F], which of ``triangles`` [F, 3] have a corner that it lies on."""
        return np.isin(triangles, self.vertex).any(axis=1)


def mirrored(strength: Tensor, sin2: Tensor, roughness: float) -> Tensor:
    """Radiance that a film of weight 1 sends to the camera, of the shape of ``strength`` and ``sin2``.

    The GGX lobe at the mirror direction, where n·ωi = n·ωo = cos_d: F·D·G/(4 n·ωi n·ωo) × n·ωi is F·D/(4
    cos_d) for a lobe so narrow that G is 1 (Walter et al. 2007, eq. 20), and cos_d is 1 to 1e-2 for guides
    beside the lens.

    Args:
        strength: 2π·L of the guide. sin2: |n × wm|², wm the half vector.
    """
    return strength * (shading.F0_WATER / 4) * shading.ggx(sin2, torch.tensor(roughness**2, dtype=sin2.dtype))


def mirrors(
    points_mm: np.ndarray,
    guides_mm: np.ndarray,
    profile: float,
    log_light: tuple[float, float, float],
    visible: np.ndarray | None = None,
) -> tuple[np.ndarray, Tensor]:
    """How K guides stand to ``points_mm`` [N, 3], all in the camera frame.

    Args:
        log_light: ln L0, n and q. visible: [N, K], share of each guide that the point sees; all unless given.

    Returns:
        half vectors float32 [N, K, 3]; strengths 2π·L of the guides, which share the light, [N, K].
    """
    towards = guides_mm - points_mm[:, None]
    distance_mm = np.maximum(np.sqrt(dot(towards, towards)), DISTANCE_MIN_MM)
    wi = towards / distance_mm[..., None]
    axis = log_axis(np.maximum(-wi[..., 2], COS_MIN), profile)
    columns = (torch.from_numpy(each) for each in (axis, np.log(distance_mm)))
    strength = torch.exp(shading.log_spotlight(*log_light, *columns)) * (2 * math.pi / len(guides_mm))
    if visible is not None:
        strength = strength * torch.from_numpy(visible)
    return unit(wi + unit(-points_mm)[:, None]), strength


def mirrors_in_view(
    points_mm: np.ndarray,
    T_local_camera: np.ndarray,
    guides_mm: np.ndarray,
    profile: float,
    log_light: tuple[float, float, float],
    caster: Caster | None,
) -> tuple[np.ndarray, Tensor]:
    """``mirrors`` of ``points_mm`` [N, 3], with half vectors, in the surface's frame, in the view from
    ``T_local_camera`` [4, 4]; guides are dark where the surface of ``caster`` hides them (None: nowhere)."""
    rotation = T_local_camera[:3, :3]
    seen_mm = ((points_mm - T_local_camera[:3, 3]) @ rotation).astype(np.float32)
    visible = None if caster is None else visible_from(caster, T_local_camera, seen_mm, guides_mm)
    half, strength = mirrors(seen_mm, guides_mm, profile, log_light, visible)
    return half @ rotation.T.astype(np.float32), strength


def film_in_view(
    film: Film,
    roughness: float,
    vertices_mm: np.ndarray,
    T_local_camera: np.ndarray,
    guides_mm: np.ndarray,
    profile: float,
    log_light: tuple[float, float, float],
    caster: Caster | None,
) -> np.ndarray:
    """Radiance that ``film`` at each of ``vertices_mm`` [V, 3] sends to the camera, float32 [V]; the other
    arguments are those of ``mirrors_in_view``."""
    half, strength = mirrors_in_view(
        vertices_mm[film.vertex], T_local_camera, guides_mm, profile, log_light, caster
    )
    across = np.cross(film.normal[:, None], half)
    lobe = mirrored(strength, torch.from_numpy(dot(across, across)), roughness).sum(dim=1)
    return film.on_all(film.weight * lobe.numpy(), len(vertices_mm))

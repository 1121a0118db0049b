"""Light that the white lobes of tissue throw on tissue: where a scope's light grazes the wall, on down the
lumen, white and not evenly all around.

Far walls get a good part of their green and blue light so. From the second bounce on light comes from
everywhere, and even lobes do. On to the camera a point sends what it mirrors: a wet wall seen at a grazing
angle shows the bright tissue before it.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from endotwin.light import shading
from endotwin.light.forward import Lobes
from endotwin.light.incidence import COS_MIN
from endotwin.surface.vectors import dot, frame_along, unit

TURN = (math.sqrt(5) - 1) / 2
"""From facet to facet about the normal, of a full turn: the golden angle."""

HIGHEST = 1 - 1e-6
"""Share of facets that stand less steep than the steepest that is drawn."""


def mirrored(
    normals: np.ndarray, to_light: np.ndarray, draw: np.ndarray, facets: int
) -> tuple[np.ndarray, np.ndarray]:
    """Where facets of N points mirror light, directions float32 [N · facets, 3], and how much of it goes
    there, [N · facets], per ρ, the share of light from all around that the points' white lobes send back.

    The lobe is GGX with Schlick's Fresnel term, of the usual tissue. Facets have the density D(m)·(n·m)
    (Walter et al. 2007, eqs. 35, 36 and 41): a spiral about the normal, placed by ``draw``.

    Args:
        normals, to_light: unit float32 [N, 3]. draw: even in [0, 1), [N, 2].
    """
    roughness, f0 = torch.tensor(shading.ROUGHNESS_TISSUE), shading.F0_DIELECTRIC
    facet, slope = _facets(normals, float(roughness**2), draw, facets)
    normal, light = np.repeat(normals, facets, axis=0), np.repeat(to_light, facets, axis=0)
    facing = dot(light, facet)
    out = 2 * facing[:, None] * facet - light
    cos_i, cos_o = (torch.from_numpy(np.maximum(dot(normal, x), COS_MIN)) for x in (light, out))
    fresnel = shading.schlick(torch.from_numpy(facing.clip(0, 1)), f0)
    lobe = (4 * cos_o * shading.smith_visibility(cos_i, cos_o, roughness**2) * fresnel).numpy()
    share = lobe * facing * np.sqrt(1 + slope * slope) / float(facets * Lobes(f0).glossy_albedo(roughness))
    return out, np.where((facing > 0) & (dot(normal, out) > 0), share, 0)


def _facets(
    normals: np.ndarray, alpha: float, draw: np.ndarray, facets: int
) -> tuple[np.ndarray, np.ndarray]:
    """Unit float32 [N · facets, 3], and the tangents of their angles to the normals, [N · facets]."""
    number = np.arange(facets, dtype=np.float32)
    u = np.minimum((number + draw[:, :1]) / facets, HIGHEST)
    slope, turn = alpha * np.sqrt(u / (1 - u)), 2 * math.pi * (TURN * number + draw[:, 1:])
    side, other, _ = np.moveaxis(frame_along(normals)[:, None], 2, 0)
    aside = np.cos(turn)[..., None] * side + np.sin(turn)[..., None] * other
    facet = unit((normals[:, None] + slope[..., None] * aside).reshape(-1, 3))
    return facet.astype(np.float32), slope.ravel().astype(np.float32)

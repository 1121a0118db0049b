"""What share of the light from its surroundings a rough dielectric reflects to the eye."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from independent.light import dot
from independent.wall import about, sampled

NODES = 33
FACETS = 24
SMOOTHEST, ROUGHEST = 0.05, 0.95


class Gloss:
    """Directional albedo R(cosθ, roughness) of a GGX lobe with reflectance ``f0`` head on, in a table.

    Facets are drawn with density D·cosθ_m (Walter et al. 2007, eqs. 35 and 36): R is the mean of
    F·G·(ω_o·m)/(cosθ_m·cosθ_o) over them (eq. 41).
    """

    def __init__(self, f0: float):
        self.f0 = f0

    def at(self, cos: np.ndarray, roughness: np.ndarray) -> np.ndarray:
        """R of cosines [N] and roughnesses [N], [N]."""
        row = (NODES - 1) * (roughness - SMOOTHEST) / (ROUGHEST - SMOOTHEST)
        column = np.clip(cos, 0.02, 1) * (NODES - 1)
        return sampled(self._table, np.stack([row, column], axis=1))[:, 0]

    def mean(self, roughness: np.ndarray) -> np.ndarray:
        """Share of even light that is reflected in all, [N]: 2·∫R·cosθ d cosθ."""
        cos = (np.arange(16) + 0.5) / 16
        return sum(self.at(np.full(len(roughness), c), roughness) * c for c in cos) / 8

    @cached_property
    def _table(self) -> np.ndarray:
        cell = (np.arange(FACETS) + 0.5) / FACETS
        u, turn = (grid.ravel() for grid in np.meshgrid(cell, 2 * np.pi * cell))
        alpha = (np.linspace(SMOOTHEST, ROUGHEST, NODES) ** 2)[:, None, None]
        cos = np.maximum(np.linspace(0, 1, NODES), 0.01)[None, :, None]
        cos_m = np.sqrt((1 - u) / (1 + (alpha**2 - 1) * u))
        facing = cos * cos_m + np.sqrt((1 - cos**2) * (1 - cos_m**2)) * np.cos(turn)
        cos_i = 2 * facing * cos_m - cos
        passed = np.where((facing > 0) & (cos_i > 0), facing / (cos_m * cos), 0)
        for c in (cos, np.maximum(cos_i, 1e-4)):
            passed = passed * 2 / (1 + np.sqrt(1 + alpha**2 * (1 / c**2 - 1)))
        fresnel = self.f0 + (1 - self.f0) * (1 - np.clip(facing, 0, 1)) ** 5
        return (fresnel * passed).mean(axis=2)[..., None]


def reflected(
    normals: np.ndarray, to_light: np.ndarray, roughness: np.ndarray, f0: float, u: np.ndarray, v: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Directions [N, 3] in which facets drawn by u, v in [0, 1) reflect light from unit ``to_light`` [N, 3],
    and the share of it that each stands for, whose mean is the directional albedo (eqs. 35, 36 and 41)."""
    alpha2 = roughness**4
    cos_m = np.sqrt((1 - u) / (1 + (alpha2 - 1) * u))
    facets = about(normals, cos_m, v)
    facing, cos_i = dot(to_light, facets), dot(to_light, normals)
    out = 2 * facing[:, None] * facets - to_light
    cos_o = dot(out, normals)
    share = np.where((facing > 0) & (cos_o > 0), facing / (cos_m * np.maximum(cos_i, 1e-4)), 0)
    for cos in (cos_i, cos_o):
        share = share * 2 / (1 + np.sqrt(1 + alpha2 * (1 / np.maximum(cos, 1e-4) ** 2 - 1)))
    return out, share * (f0 + (1 - f0) * (1 - np.clip(facing, 0, 1)) ** 5)

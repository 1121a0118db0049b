"""Lamps at the tip of an endoscope, and how tissue reflects their light.

Sources: Burley 2012 (diffuse), Walter et al. 2007 (GGX), Schlick 1994 (Fresnel), Azagra et al. 2023 (profile
e^{−n(1−cosθ)}). ``to_light`` and ``to_eye`` are unit vectors that leave the surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from independent.wall import unit

AT_LENS = ((0.0, 0.0, 0.0),)
F0_WATER = 0.02


@dataclass(frozen=True)
class Lamp:
    """Equal guides that shine along the camera's z and share the strength L0: E = L0/K·A(θ)/d^q head on.

    Attributes:
        exponential: A = e^{−n(1−cosθ)} instead of cosⁿθ. guides_mm: in the camera frame.
    """

    L0: float
    n: float
    q: float
    exponential: bool = False
    guides_mm: tuple[tuple[float, float, float], ...] = AT_LENS

    def arriving(self, guide: int, points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Strength [N] that guide number ``guide`` has at points [N, 3] of the camera frame, and unit
        directions [N, 3] to it. The tip of the scope keeps its light from what lies behind it."""
        ray = np.asarray(self.guides_mm[guide], points_mm.dtype) - points_mm
        distance_mm = np.sqrt((ray * ray).sum(axis=1))
        to_light = ray / distance_mm[:, None]
        cos = np.maximum(-to_light[:, 2], 0)
        angular = (cos > 0) * (np.exp(self.n * (cos - 1)) if self.exponential else cos**self.n)
        return self.L0 / len(self.guides_mm) * angular / distance_mm**self.q, to_light


def lambert(cos_light: np.ndarray) -> np.ndarray:
    """π·f_r·cosθ_i of a white Lambertian surface."""
    return np.maximum(cos_light, 0)


def burley(
    normals: np.ndarray, to_light: np.ndarray, to_eye: np.ndarray, roughness: np.ndarray
) -> np.ndarray:
    """π·f_r·cosθ_i of Disney's diffuse lobe with white base colour: (1 + (F − 1)(1 − cosθ_i)⁵)(1 + (F −
    1)(1 − cosθ_o)⁵), F = ½ + 2·roughness·cos²θ_d."""
    half = unit(to_light + to_eye)
    cos_light, cos_eye = dot(normals, to_light), dot(normals, to_eye)
    rise = 2 * roughness * dot(to_light, half) ** 2 - 0.5
    lobe = (1 + rise * (1 - np.clip(cos_light, 0, 1)) ** 5) * (1 + rise * (1 - np.clip(cos_eye, 0, 1)) ** 5)
    return lobe * np.maximum(cos_light, 0)


def ggx(
    normals: np.ndarray, to_light: np.ndarray, to_eye: np.ndarray, roughness: np.ndarray | float, f0: float
) -> np.ndarray:
    """f_r·cosθ_i = D·F·G/(4 cosθ_o) [N] of rough dielectric with α = roughness²: D(m) = α²/(π(cos²θ_m(α² −
    1) + 1)²), G = Π 2/(1 + √(1 + α² tan²θ)), F = f0 + (1 − f0)(1 − cosθ_d)⁵."""
    half = unit(to_light + to_eye)
    cos_light, cos_eye = dot(normals, to_light), np.maximum(dot(normals, to_eye), 1e-4)
    alpha2 = roughness**4
    across = np.cross(normals, half)
    sin2 = dot(across, across)
    density = alpha2 / (np.pi * (sin2 + alpha2 * (1 - sin2)) ** 2)
    fresnel = f0 + (1 - f0) * (1 - np.clip(dot(to_light, half), 0, 1)) ** 5
    lit = np.maximum(cos_light, 1e-4)
    passed = 1.0
    for cos in (lit, cos_eye):
        passed = passed * 2 / (1 + np.sqrt(1 + alpha2 * (1 / (cos * cos) - 1)))
    return np.where(cos_light > 0, density * fresnel * passed / (4 * cos_eye), 0)


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Products [N] of vectors [N, 3]."""
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]

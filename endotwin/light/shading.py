"""Light on tissue: the spotlight, the Disney/GGX BRDF and the camera response, in torch.

Vocabulary as in the literature: ``n`` surface normal, ``wi`` unit direction to the light, ``wo`` to the
camera, ``wm`` the half vector; ``cos_i`` = n·wi, ``cos_o`` = n·wo, ``sin2_m`` = |n × wm|². Sources: Han &
Wu 2025 (EndoPBR); Burley 2012 (Disney BRDF); Walter et al. 2007 (GGX, Smith shadowing).

Everything is finite, with finite gradients, for cos in [0, 1], roughness in [0, 1] and distance > 0: the
1/(4 cos_i cos_o) of the microfacet model is cancelled analytically against Smith's G, and powers are taken
of logarithms.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

F0_DIELECTRIC = 0.04
"""Reflectance of tissue at normal incidence: ((1.5 - 1) / (1.5 + 1))², Burley's ``specular`` 0.5."""

F0_WATER = 0.02
"""((1.33 − 1) / (1.33 + 1))²."""

ROUGHNESS_TISSUE = 0.4
"""Roughness of tissue where nothing tells it yet."""

ROUGHNESS_MIN = 0.045
"""Least roughness: α = r² = 0.002 keeps the GGX peak 1/(π α²) and its slope within float32."""

NODES = 33
"""Of the table of what a lobe does with light from all around."""

RADIANCE_MIN = 1e-6
"""Least radiance that the response sees; x^γ has infinite slope at 0. In display values 1e-6^(1/2.2) is half
an 8-bit step.
"""


def log_spotlight(
    log_intensity: float | Tensor,
    cone: float | Tensor,
    falloff: float | Tensor,
    log_cos_axis: Tensor,
    log_distance: Tensor,
) -> Tensor:
    """Logarithm of L(x) = L0·cosⁿθ / d^q (Han & Wu, light model).

    Args:
        log_intensity: ln L0, []. cone: n, []. falloff: q, [].
        log_cos_axis: ln cosθ, [N], θ between the optical axis and the direction from the light.
            log_distance: ln d, d in mm, [N].
    """
    return log_intensity + cone * log_cos_axis - falloff * log_distance


def burley(cos_i: Tensor, cos_o: Tensor, cos_d: Tensor, roughness: Tensor) -> Tensor:
    """Retro-reflection of rough diffuse surfaces at grazing angles, [N]: Burley 2012, sec. 5.3, with
    π·f_d/base_color = 1 head-on.

    Written as in Burley 2015 (eq. 4): (1 − F_i/2)(1 − F_o/2) + R (F_i + F_o + F_i F_o (R − 1)), R =
    2·roughness·cos_d².
    """
    fresnel_i, fresnel_o = fifth_power(1 - cos_i), fifth_power(1 - cos_o)
    retro = 2 * roughness * cos_d * cos_d
    return (1 - fresnel_i / 2) * (1 - fresnel_o / 2) + retro * (
        fresnel_i + fresnel_o + fresnel_i * fresnel_o * (retro - 1)
    )


def diffuse(base_color: Tensor, metallic: Tensor) -> Tensor:
    """Lambertian lobe f_d = (1 − m)·b/π, [N, 3], of base_color [N, 3] and metallic [N] (Han & Wu)."""
    return base_color * ((1 - metallic) / math.pi)[..., None]


def ggx(sin2_m: Tensor, alpha: Tensor) -> Tensor:
    """GGX normal distribution D(wm) [N] (Walter et al. 2007, eq. 33), from sin² for precision at the peak.

    With c² = 1 − s² the usual denominator c²(α² − 1) + 1 is s² + α²c², without cancellation.
    """
    alpha2 = alpha * alpha
    return alpha2 / (math.pi * (sin2_m + alpha2 * (1 - sin2_m)) ** 2)


def gtr(sin2_m: Tensor, alpha: Tensor, tail: float) -> Tensor:
    """Generalised Trowbridge–Reitz distribution D(wm) [N] ∝ (s² + α²c²)^−tail (Burley 2012, appendix B.2), of
    integral ∫D·(n·wm) = 1: GGX for a tail of 2, Berry's for 1, whose haze reaches far from the peak.

    Its constant (tail − 1)(1 − α²)/(π(α^{2−2·tail} − 1)) is written so that it has its limit at 1.
    """
    log_width = -2 * torch.log(alpha).clamp_max(-1e-9)
    stretch = ((tail - 1) * log_width).clamp_min(1e-9)
    norm = -torch.expm1(-log_width) / log_width * (stretch / torch.expm1(stretch))
    return norm / (math.pi * (sin2_m + alpha * alpha * (1 - sin2_m)) ** tail)


def smith_visibility(cos_i: Tensor, cos_o: Tensor, alpha: Tensor) -> Tensor:
    """G / (4 cos_i cos_o) [N] with Smith's separable G for GGX (Walter et al. 2007, eq. 34), cancelled:
    bounded by 1/(4α²).
    """

    def half(cos: Tensor) -> Tensor:
        return cos + torch.sqrt(alpha * alpha * (1 - cos * cos) + cos * cos)

    return 1 / (half(cos_i) * half(cos_o))


def specular(
    cos_i: Tensor, cos_o: Tensor, sin2_m: Tensor, cos_d: Tensor, roughness: Tensor, f0: Tensor
) -> Tensor:
    """White GGX lobe f_s = D·F·G / (4 cos_i cos_o), [N]; ``cos_d`` = wi·wm enters Schlick's F = f0 + (1 −
    f0)(1 − cos_d)⁵.
    """
    return specular_lobe(cos_i, cos_o, sin2_m, roughness) * schlick(cos_d, f0)


def schlick(cos_d: Tensor, f0: Tensor | float) -> Tensor:
    """Fresnel's reflectance [N], f0 head on (Schlick 1994)."""
    return f0 + (1 - f0) * fifth_power(1 - cos_d)


def fifth_power(x: Tensor) -> Tensor:
    """x⁵, in an eighth of the time of ``x ** 5``."""
    squared = x * x
    return squared * squared * x


def specular_lobe(cos_i: Tensor, cos_o: Tensor, sin2_m: Tensor, roughness: Tensor) -> Tensor:
    """``specular`` per unit of f0, for a light so near the lens that Schlick's (1 − cos_d)⁵ vanishes: 1e-9
    at 10° between them."""
    alpha = roughness.clamp_min(ROUGHNESS_MIN) ** 2
    return ggx(sin2_m, alpha) * smith_visibility(cos_i, cos_o, alpha)


def coat_lobe(cos_i: Tensor, cos_o: Tensor, sin2_m: Tensor, roughness: float, tail: float) -> Tensor:
    """The white lobe of a coat, [N], per unit of its reflectance: as ``specular_lobe``, with the haze of its
    tail."""
    alpha = sin2_m.new_tensor(max(roughness, ROUGHNESS_MIN) ** 2)
    return gtr(sin2_m, alpha, tail) * smith_visibility(cos_i, cos_o, alpha)


def specular_colocated(cos: Tensor, sin2: Tensor, roughness: Tensor) -> Tensor:
    """``specular`` per unit of f0, with the light at the lens: wi = wo = wm, so cos_d = 1 and F = f0."""
    return specular_lobe(cos, cos, sin2, roughness)


def specular_of_even_light(cos_o: Tensor, roughness: Tensor, f0: float) -> Tensor:
    """Share of light from all around that the white GGX lobe sends to the camera, [N]: f0·A + B, from a table
    of both (Karis 2013, "Real Shading in Unreal Engine 4"), within 0.005 of the integral."""
    cos_o, roughness = torch.broadcast_tensors(cos_o, roughness)
    place = 2 * torch.stack([cos_o.reshape(-1), roughness.reshape(-1)], dim=-1) - 1
    table = _even_light().to(place)
    found = grid_sample(table, place[None, None], padding_mode="border", align_corners=True)
    scale, bias = found[0, :, 0]
    return (f0 * scale + bias).reshape(cos_o.shape)


@cache
def _even_light() -> Tensor:
    """A and B, float64 [1, 2, NODES, NODES] over roughness and n·wo, each even in 0 … 1: the mean over facets
    of density D(m)·(n·m), on one side of the view, of what they mirror (Walter et al. 2007, eqs. 35, 36 and
    41)."""
    nodes = torch.linspace(0, 1, NODES, dtype=torch.float64)
    middle, half = ((torch.arange(count, dtype=torch.float64) + 0.5) / count for count in (NODES, NODES // 2))
    roughness, cos_o, u, turn = torch.meshgrid(nodes, nodes, middle, math.pi * half, indexing="ij")
    alpha = roughness.clamp_min(ROUGHNESS_MIN) ** 2
    cos_m = torch.sqrt((1 - u) / (1 + (alpha * alpha - 1) * u))
    aside = torch.sqrt((1 - cos_o * cos_o) * (1 - cos_m * cos_m))
    facing = (cos_o * cos_m + aside * torch.cos(turn)).clamp_min(0)
    cos_i = (2 * facing * cos_m - cos_o).clamp_min(0)
    sent = 4 * cos_i * facing * smith_visibility(cos_i, cos_o, alpha) / cos_m
    grazing = sent * schlick(facing, 0.0)
    return torch.stack([(sent - grazing).mean(dim=(2, 3)), grazing.mean(dim=(2, 3))])[None]


def respond(radiance: Tensor, gamma: float | Tensor) -> Tensor:
    """Camera response C = x^γ of radiance x ≥ 0, shifted so that C(0) = 0 with the slope that x^γ has at
    RADIANCE_MIN.
    """
    gamma = torch.as_tensor(gamma, dtype=radiance.dtype)
    return torch.exp(gamma * torch.log(radiance + RADIANCE_MIN)) - torch.exp(gamma * math.log(RADIANCE_MIN))


def radiance_of(color: np.ndarray, gamma: float) -> np.ndarray:
    """Radiance x that ``respond`` shows as C = ``color`` below 1, of its shape."""
    return (color + RADIANCE_MIN**gamma) ** (1 / gamma) - RADIANCE_MIN

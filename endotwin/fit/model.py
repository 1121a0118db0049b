"""The forward model of a training pixel and its derivatives, for least squares.

A pixel's radiance is linear in its base colour, x = Σ_k g_k·(D_k·b/π + f0·S_k) + 2·E·(b + ρ), with g =
2π·L·(n·ω) of each light guide, D the diffuse factor, S the specular lobe E what other tissue throws on it
and ρ the lobe's share of that; the photo shows C = x^γ
(Han & Wu 2025 with one guide at the lens and no E; Burley's diffuse lobe).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from endotwin.effects.coat import F0_WATER, Coat
from endotwin.light import shading
from endotwin.pixels.samples import Samples
from endotwin.twin import Light, Response

GLOBALS = ("gamma·ln L0", "gamma·n", "gamma·q", "gamma", "ln f0")
"""The shared parameters as they are fitted: those in which a diffuse surface's log C is linear."""

BOUNCE_GLOBALS = (*GLOBALS, "ln albedo scale")
"""With interreflection there is one more: it tells how bright the tissue is beside the light."""


@dataclass(frozen=True)
class Globals:
    """What all pixels share, as one vector float64 [5] in the order of GLOBALS, or [6] of BOUNCE_GLOBALS.

    Without ``specular`` there is no specular lobe, and ln f0 stays where it is. A ``coat`` adds a lobe of its
    own.
    """

    vector: Tensor
    specular: bool = True
    coat: Coat | None = None

    @classmethod
    def of(
        cls, light: Light, response: Response, f0: float, specular: bool = True, bounce: bool = False
    ) -> Globals:
        gamma = response.gamma
        values = [gamma * math.log(light.L0), gamma * light.n, gamma * light.q, gamma, math.log(f0)]
        return cls(torch.tensor(values + [0.0] * bounce, dtype=torch.float64), specular)

    @property
    def log_light(self) -> tuple[float, float, float]:
        """ln L0, n, q."""
        return tuple((self.vector[:3] / self.vector[3]).tolist())

    @property
    def light(self) -> Light:
        log_L0, n, q = self.log_light
        return Light(L0=math.exp(log_L0), n=n, q=q)

    @property
    def gamma(self) -> float:
        return float(self.vector[3])

    @property
    def f0(self) -> float:
        return math.exp(self.vector[4]) if self.specular else 0.0

    def without_scale(self) -> Globals:
        """The same without interreflection."""
        return replace(self, vector=self.vector[: len(GLOBALS)])

    @property
    def log_scale(self) -> float:
        """ln of the factor on all albedo; 0 without interreflection."""
        return float(self.vector[5]) if len(self.vector) > len(GLOBALS) else 0.0


def at_pixels(samples: Samples, triangles: Tensor, per_vertex: Tensor) -> Tensor:
    """Vertex values [V, C] interpolated at the samples, [N, C]; ``triangles`` int64 [F, 3]."""
    corners = per_vertex[triangles[samples.triangle]]
    return torch.einsum("nk,nkc->nc", samples.barycentric, corners)


@dataclass(frozen=True)
class _Lit:
    """What one guide does at N pixels: x = per_color·b + shine + weight·coat; each [N], like its ln of cone
    and distance."""

    per_color: Tensor
    shine: Tensor | None
    coat: Tensor | None
    log_axis: Tensor
    log_distance: Tensor


def _guides(samples: Samples, roughness: Tensor, shared: Globals) -> list[_Lit]:
    """Each guide's light on the samples; the light at the lens is a case of its own, and cheaper."""
    exposure = 0.0 if samples.log_exposure is None else samples.log_exposure
    if samples.guides is None:
        log_strength = shading.log_spotlight(*shared.log_light, samples.log_cos_axis, samples.log_distance)
        strength = torch.exp(log_strength + exposure) * samples.cos * (2 * math.pi)
        one = torch.ones_like(samples.cos)
        per_color = strength * shading.burley(samples.cos, samples.cos, one, roughness) / math.pi

        def lobe(roughness: Tensor) -> Tensor:
            return strength * shading.specular_colocated(samples.cos, samples.sin2, roughness)

        shine, coat = _lobes(lobe, roughness, shared)
        return [_Lit(per_color, shine, coat, samples.log_cos_axis, samples.log_distance)]
    guides, found = samples.guides, []
    count = guides.cos_i.shape[1]
    for k in range(count):
        cos_i, log_axis, log_distance = (
            value[:, k] for value in (guides.cos_i, guides.log_axis, guides.log_distance)
        )
        log_strength = shading.log_spotlight(*shared.log_light, log_axis, log_distance)
        strength = torch.exp(log_strength + exposure) * cos_i * (2 * math.pi / count)
        per_color = strength * shading.burley(cos_i, samples.cos, guides.cos_d[:, k], roughness) / math.pi

        def lobe(roughness: Tensor, k=k, cos_i=cos_i, strength=strength) -> Tensor:
            return strength * shading.specular_lobe(cos_i, samples.cos, guides.sin2_m[:, k], roughness)

        shine, coat = _lobes(lobe, roughness, shared)
        found.append(_Lit(per_color, shine, coat, log_axis, log_distance))
    return found


def _lobes(
    lobe: Callable[[Tensor], Tensor], roughness: Tensor, shared: Globals
) -> tuple[Tensor | None, Tensor | None]:
    """The tissue's highlight, and that of a coat of weight 1; None where there is none."""
    shine = shared.f0 * lobe(roughness) if shared.specular else None
    if shared.coat is None:
        return shine, None
    return shine, F0_WATER * lobe(torch.full_like(roughness, shared.coat.roughness).detach())


def _bounced(samples: Samples, shared: Globals) -> Tensor:
    """2·E of the samples, [N, 3]."""
    bounce, (log_L0, n, q) = samples.bounce, shared.log_light
    log_factor = log_L0 + n * bounce.by_n + q * bounce.by_q + shared.log_scale * bounce.by_scale
    if samples.log_exposure is not None:
        log_factor = log_factor + samples.log_exposure
    return 2 * torch.exp(bounce.log + log_factor[:, None])


def radiance(samples: Samples, material: Tensor, shared: Globals) -> Tensor:
    """Radiance x [N, 3] of the samples with ``material``: base colour and roughness at the pixels, [N, 4]."""
    lit = _guides(samples, material[:, 3], shared)
    x = sum(guide.per_color for guide in lit)[:, None] * material[:, :3]
    if shared.specular:
        x = x + sum(guide.shine for guide in lit)[:, None]
    if shared.coat is not None:
        x = x + shared.coat.weight * sum(guide.coat for guide in lit)[:, None]
    if samples.bounce is None:
        return x
    return x + _bounced(samples, shared) * (material[:, :3] + samples.bounce.gloss[:, None])


def predict(samples: Samples, material: Tensor, shared: Globals) -> Tensor:
    """Display values C [N, 3]; above 1 where a photo would clip."""
    return shading.respond(radiance(samples, material, shared), shared.gamma)


def slope_by_log_exposure(samples: Samples, material: Tensor, shared: Globals) -> tuple[Tensor, Tensor]:
    """Display values C [N, 3] and dC/d ln x [N, 3]: what a change of exposure does."""
    x = radiance(samples, material, shared)
    power = torch.exp(shared.gamma * torch.log(x + shading.RADIANCE_MIN))
    floor = math.exp(shared.gamma * math.log(shading.RADIANCE_MIN))
    return power - floor, shared.gamma * power * x / (x + shading.RADIANCE_MIN)


@dataclass(frozen=True)
class Linearised:
    """Prediction and derivatives at N samples.

    Attributes:
        predicted: [N, 3]. by_color: dC/db [N, 3] (each channel by its own base colour).
        by_roughness: dC/dr [N, 3]. by_globals: dC by the shared parameters, [N, 3, 5 or 6].
        by_coat: dC by the coat's weight, [N, 3]; None: there is no coat.
    """

    predicted: Tensor
    by_color: Tensor
    by_roughness: Tensor
    by_globals: Tensor
    by_coat: Tensor | None


def linearise(samples: Samples, material: Tensor, shared: Globals) -> Linearised:
    """The model and its derivatives at ``material`` [N, 4]; those by roughness come from automatic
    differentiation.
    """
    roughness = material[:, 3].detach().requires_grad_()
    with torch.enable_grad():
        lit = _guides(samples, roughness, shared)
        per_color = sum(guide.per_color for guide in lit)
        shine = sum(guide.shine for guide in lit) if shared.specular else torch.zeros_like(per_color)
        color_slope = torch.autograd.grad(per_color.sum(), roughness, retain_graph=True)[0]
        shine_slope = 0 * color_slope
        if shared.specular:
            shine_slope = torch.autograd.grad(shine.sum(), roughness)[0]
    base_color, per_color, shine = material[:, :3].detach(), per_color.detach()[:, None], shine.detach()
    x = per_color * base_color + shine[:, None]
    coat = None if shared.coat is None else sum(guide.coat for guide in lit).detach()[:, None]
    if coat is not None:
        x = x + shared.coat.weight * coat
    axis, distance = _moments(lit, base_color, shared)
    if samples.bounce is not None:
        bounced = _bounced(samples, shared)
        glow = bounced * (base_color + samples.bounce.gloss[:, None])
        x, per_color = x + glow, per_color + bounced
        axis = axis + glow * samples.bounce.by_n[:, None]
        distance = distance - glow * samples.bounce.by_q[:, None]
    gamma, (log_L0, n, q) = shared.gamma, shared.log_light
    log_x = torch.log(x + shading.RADIANCE_MIN)
    power = torch.exp(gamma * log_x)
    slope = gamma * power / (x + shading.RADIANCE_MIN)
    log_floor = math.log(shading.RADIANCE_MIN)
    floor = math.exp(gamma * log_floor)
    by_color = slope * per_color
    by_light = slope / gamma
    by_gamma = power * log_x - floor * log_floor - by_light * (log_L0 * x + n * axis - q * distance)
    by_gamma = by_gamma - by_color * base_color * torch.log(base_color) / gamma
    by_globals = [by_light * x, by_light * axis, -by_light * distance, by_gamma, slope * shine[:, None]]
    if samples.bounce is not None:
        by_globals.append(slope * glow * samples.bounce.by_scale[:, None])
    return Linearised(
        predicted=power - floor,
        by_color=by_color,
        by_roughness=slope * (color_slope[:, None] * base_color + shine_slope[:, None]),
        by_globals=torch.stack(by_globals, dim=-1),
        by_coat=None if coat is None else slope * coat,
    )


def _moments(lit: list[_Lit], base_color: Tensor, shared: Globals) -> tuple[Tensor, Tensor]:
    """Σ_k x_k·(ln cone)_k and Σ_k x_k·(ln d)_k, [N, 3] each."""
    axis = distance = 0.0
    for guide in lit:
        x = guide.per_color.detach()[:, None] * base_color
        if guide.shine is not None:
            x = x + guide.shine.detach()[:, None]
        if guide.coat is not None:
            x = x + shared.coat.weight * guide.coat.detach()[:, None]
        axis, distance = axis + x * guide.log_axis[:, None], distance + x * guide.log_distance[:, None]
    return axis, distance

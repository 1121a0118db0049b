"""The forward model of a training pixel and its derivatives, for least squares.

A pixel's radiance is linear in its base colour, x = g·(D·b + f0·S), with g = 2π·L·(n·ω), D the diffuse
factor and S the specular lobe; the photo shows C = x^γ (Han & Wu 2025, with Burley's diffuse lobe).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from endotwin import shading
from endotwin.fit.samples import Samples
from endotwin.twin import Light, Response

GLOBALS = ("gamma·ln L0", "gamma·n", "gamma·q", "gamma", "ln f0")
"""The shared parameters as they are fitted: those in which a diffuse surface's log C is linear."""


@dataclass(frozen=True)
class Globals:
    """What all pixels share, as one vector float64 [5] in the order of GLOBALS."""

    vector: Tensor

    @classmethod
    def of(cls, light: Light, response: Response, f0: float) -> Globals:
        gamma = response.gamma
        values = [gamma * math.log(light.L0), gamma * light.n, gamma * light.q, gamma, math.log(f0)]
        return cls(torch.tensor(values, dtype=torch.float64))

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
        return math.exp(self.vector[4])


def at_pixels(samples: Samples, triangles: Tensor, per_vertex: Tensor) -> Tensor:
    """Vertex values [V, C] interpolated at the samples, [N, C]; ``triangles`` int64 [F, 3]."""
    corners = per_vertex[triangles[samples.triangle]]
    return torch.einsum("nk,nkc->nc", samples.barycentric, corners)


def radiance(samples: Samples, material: Tensor, shared: Globals) -> tuple[Tensor, Tensor, Tensor]:
    """Radiance x [N, 3] of the samples, and the parts it is made of.

    Args:
        material: base colour and roughness at the pixels, [N, 4].

    Returns:
        x; g·D [N], its derivative by base colour; g·f0·S [N], its specular part.
    """
    strength = torch.exp(shading.log_spotlight(*shared.log_light, samples.log_cos_axis, samples.log_distance))
    strength = strength * samples.cos * (2 * math.pi)
    roughness = material[:, 3]
    one = torch.ones_like(samples.cos)
    per_color = strength * shading.burley(samples.cos, samples.cos, one, roughness) / math.pi
    shine = strength * shared.f0 * shading.specular_colocated(samples.cos, samples.sin2, roughness)
    return per_color[:, None] * material[:, :3] + shine[:, None], per_color, shine


def predict(samples: Samples, material: Tensor, shared: Globals) -> Tensor:
    """Display values C [N, 3]; above 1 where a photo would clip."""
    return shading.respond(radiance(samples, material, shared)[0], shared.gamma)


@dataclass(frozen=True)
class Linearised:
    """Prediction and derivatives at N samples.

    Attributes:
        predicted: [N, 3]. by_color: dC/db [N, 3] (each channel by its own base colour).
        by_roughness: dC/dr [N, 3]. by_globals: dC/dGLOBALS [N, 3, 5].
    """

    predicted: Tensor
    by_color: Tensor
    by_roughness: Tensor
    by_globals: Tensor


def linearise(samples: Samples, material: Tensor, shared: Globals) -> Linearised:
    """The model and its derivatives at ``material`` [N, 4]; those by roughness come from automatic
    differentiation.
    """
    material = material.detach().requires_grad_()
    with torch.enable_grad():
        x, per_color, shine = radiance(samples, material, shared)
        color_slope = torch.autograd.grad(per_color.sum(), material, retain_graph=True)[0][:, 3]
        shine_slope = torch.autograd.grad(shine.sum(), material)[0][:, 3]
    x, per_color, shine, material = x.detach(), per_color.detach(), shine.detach(), material.detach()
    gamma = shared.gamma
    log_x = torch.log(x + shading.RADIANCE_MIN)
    power = torch.exp(gamma * log_x)
    slope = gamma * power / (x + shading.RADIANCE_MIN)
    log_floor = math.log(shading.RADIANCE_MIN)
    floor = math.exp(gamma * log_floor)
    by_color = slope * per_color[:, None]
    by_log_light = slope * x / gamma
    base_color = material[:, :3]
    log_strength = shading.log_spotlight(*shared.log_light, samples.log_cos_axis, samples.log_distance)
    by_gamma = power * log_x - floor * log_floor - by_log_light * log_strength[:, None]
    by_gamma = by_gamma - by_color * base_color * torch.log(base_color) / gamma
    by_globals = [
        by_log_light,
        by_log_light * samples.log_cos_axis[:, None],
        -by_log_light * samples.log_distance[:, None],
        by_gamma,
        slope * shine[:, None],
    ]
    return Linearised(
        predicted=power - floor,
        by_color=by_color,
        by_roughness=slope * (color_slope[:, None] * base_color + shine_slope[:, None]),
        by_globals=torch.stack(by_globals, dim=-1),
    )

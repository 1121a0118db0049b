"""The radiance of a surface point: the one place where it is written, for the renderer and for the fit.

x = Σ_k g_k·(D_k·b/π + f0·S_k + w·f0_water·S'_k) + 2·L0·(E·τ·b + B·ρ), with g = 2π·L·(n·ωi) of each guide, D
the diffuse factor, S the specular lobe of the tissue and S' that of a coat of weight w, E what other tissue
throws on the point for L0 = 1, τ the share that the coat lets through, B the radiosity of what the point
mirrors to the camera, and ρ the white lobes' share of that. Han & Wu 2025 with one guide at the lens, no coat
and no E; Burley's diffuse lobe unless D is 1. It is linear in the base colour b, and in what each guide gives
exponential in n and q: the derivatives by those follow from the same pieces.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from endotwin.light import shading
from endotwin.light.guides import Guided

LogLight = tuple[float | Tensor, float | Tensor, float | Tensor]
"""ln L0, n and q of the light, as numbers or as scalar tensors that are to be differentiated by."""


@dataclass(frozen=True)
class Lit:
    """What lights N points.

    Attributes:
        cos_o: [N], n·wo. guides: how each of K guides lights them.
        log_exposure: [N], ln of what camera and lens make of all light; None: 0.
        irradiance: [N, 3], what other tissue throws on them for L0 = 1; None: nothing.
        mirrored: [N, 3], radiosity of the tissue that they mirror to the camera, for L0 = 1.
        gloss: [N, 2], share of light from there that the white lobes send on; and of what the base colour
            sends, that the coat lets through.
    """

    cos_o: Tensor
    guides: Guided
    log_exposure: Tensor | None = None
    irradiance: Tensor | None = None
    mirrored: Tensor | None = None
    gloss: Tensor | None = None

    @classmethod
    def at_lens(cls, cos: Tensor, sin2: Tensor, log_axis: Tensor, log_distance: Tensor, **more) -> Lit:
        """By the light at the lens: wi = wo = wm (see ``Incidence``, all [N])."""
        columns = (cos, sin2, torch.ones_like(cos), log_axis, log_distance)
        return cls(cos, Guided(*(value[:, None] for value in columns)), **more)


@dataclass(frozen=True)
class Lobes:
    """What all points answer light with.

    Attributes:
        f0: reflectance of the specular lobe at normal incidence; 0: there is none.
        burley: whether the diffuse lobe is Burley's, rather than Lambert's.
        coat: weight, roughness and tail of a coat; None: there is none.
    """

    f0: float
    burley: bool = True
    coat: tuple[float, float, float] | None = None

    @property
    def shine(self) -> bool:
        """Whether there is a white lobe."""
        return self.f0 > 0 or self.coat is not None

    def brighter(self, factor: float) -> Lobes:
        """The same with white lobes brighter by ``factor``."""
        coat = self.coat and (factor * self.coat[0], *self.coat[1:])
        return replace(self, f0=factor * self.f0, coat=coat)

    def gloss(self, cos_o: Tensor, roughness: Tensor) -> Tensor:
        """Of light from all around, [N, 2]: the share that the white lobes of points of ``roughness`` send to
        the camera, and that which a coat lets through of what the tissue beneath it sends there.

        A coat of weight below 1 lies on as much of the tissue; a heavier one is denser than water. As any
        layer it mirrors all of what grazes it, which the tissue then does not.
        """
        tissue = torch.zeros_like(cos_o * roughness)
        if self.f0 > 0:
            tissue = shading.specular_of_even_light(cos_o, roughness, self.f0)
        coat = self._gloss_of_coat(cos_o, roughness)
        through = 1 - coat
        return torch.stack([coat + through * tissue, through], dim=-1)

    def gloss_by_f0(self, cos_o: Tensor, roughness: Tensor) -> Tensor:
        """By how much the first of ``gloss`` grows with f0, of which it is linear, [N]."""
        grazing, whole = (shading.specular_of_even_light(cos_o, roughness, f0) for f0 in (0.0, 1.0))
        return (1 - self._gloss_of_coat(cos_o, roughness)) * (whole - grazing)

    def _gloss_of_coat(self, cos_o: Tensor, roughness: Tensor) -> Tensor:
        """What the coat alone sends of light from all around, over places of ``roughness``, [N]."""
        nothing = torch.zeros_like(cos_o * roughness)
        if self.coat is None:
            return nothing
        weight, smooth, _ = self.coat
        f0, covered = shading.F0_WATER * max(1.0, weight), min(1.0, weight)
        return covered * shading.specular_of_even_light(cos_o, torch.full_like(nothing, smooth), f0)

    def glossy_albedo(self, roughness: Tensor) -> Tensor:
        """Share of light from all around that white lobes send back in all, [N]."""
        return _in_all(lambda cos, rough: self.gloss(cos, rough)[..., 0], roughness)

    def f0_albedo(self, roughness: Tensor) -> Tensor:
        """What of ``glossy_albedo`` is in proportion to f0, [N]."""
        return self.f0 * _in_all(self.gloss_by_f0, roughness)


def _in_all(gloss: Callable[[Tensor, Tensor], Tensor], roughness: Tensor) -> Tensor:
    """2·∫gloss(cos)·cos d cos for places of ``roughness`` [N], [N]."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    cos, weights = (torch.from_numpy(x).to(roughness.dtype) for x in ((nodes + 1) / 2, weights))
    return (gloss(cos, roughness[..., None]) * cos * weights).sum(dim=-1)


@dataclass(frozen=True)
class Share:
    """What one guide gives to N points, x = per_color·b + shine + weight·coat; each [N], None where the lobe
    is not there. Its logarithm grows by log_axis with n, and falls by log_distance with q."""

    per_color: Tensor
    shine: Tensor | None
    coat: Tensor | None
    log_axis: Tensor
    log_distance: Tensor

    def white(self, lobes: Lobes) -> Tensor | None:
        """What does not depend on the base colour, [N]; None: nothing."""
        if self.coat is None:
            return self.shine
        coat = lobes.coat[0] * self.coat
        return coat if self.shine is None else self.shine + coat

    def radiance(self, base_color: Tensor, lobes: Lobes) -> Tensor:
        """[N, 3]."""
        x, white = self.per_color[:, None] * base_color, self.white(lobes)
        return x if white is None else x + white[:, None]


def shares(lit: Lit, log_light: LogLight, roughness: Tensor, lobes: Lobes) -> list[Share]:
    """What each guide gives to points of ``roughness`` [N]."""
    guides, found = lit.guides, []
    count = guides.cos_i.shape[1]
    for k in range(count):
        columns = (value[:, k].contiguous() for value in vars(guides).values())
        cos_i, sin2_m, cos_d, log_axis, log_distance = columns
        log_strength = shading.log_spotlight(*log_light, log_axis, log_distance)
        if lit.log_exposure is not None:
            log_strength = log_strength + lit.log_exposure
        strength = torch.exp(log_strength) * cos_i * (2 * math.pi / count)
        per_color = strength / math.pi
        if lobes.burley:
            per_color = per_color * shading.burley(cos_i, lit.cos_o, cos_d, roughness)
        shine = coat = None
        if lobes.f0 > 0:
            shine = strength * lobes.f0 * shading.specular_lobe(cos_i, lit.cos_o, sin2_m, roughness)
        if lobes.coat is not None:
            lobe = shading.coat_lobe(cos_i, lit.cos_o, sin2_m, *lobes.coat[1:])
            coat = strength * shading.F0_WATER * lobe
        found.append(Share(per_color, shine, coat, log_axis, log_distance))
    return found


def bounced(lit: Lit, log_light: LogLight) -> tuple[Tensor, Tensor]:
    """Of points on which other tissue throws light, 2·L0·E, what a base colour of 1 makes of it, and 2·L0·B,
    what white lobes that send on all of it do; each [N, 3]."""
    log_factor = torch.as_tensor(log_light[0], dtype=lit.irradiance.dtype)
    if lit.log_exposure is not None:
        log_factor = (log_factor + lit.log_exposure)[:, None]
    factor = 2 * torch.exp(log_factor)
    return lit.irradiance * factor * lit.gloss[:, 1:], lit.mirrored * factor


def radiance(lit: Lit, log_light: LogLight, base_color: Tensor, roughness: Tensor, lobes: Lobes) -> Tensor:
    """Radiance x [N, 3] of points with ``base_color`` [N, 3] (of the diffuse lobe: what is metallic has less)
    and ``roughness`` [N]."""
    found = shares(lit, log_light, roughness, lobes)
    x = sum(share.per_color for share in found)[:, None] * base_color
    if found[0].white(lobes) is not None:
        x = x + sum(share.white(lobes) for share in found)[:, None]
    return x if lit.irradiance is None else x + glow(lit, log_light, base_color)


def glow(lit: Lit, log_light: LogLight, base_color: Tensor) -> Tensor:
    """The share of ``radiance`` that other tissue throws on the points, [N, 3]."""
    per_color, mirrored = bounced(lit, log_light)
    return per_color * base_color + mirrored * lit.gloss[:, :1]

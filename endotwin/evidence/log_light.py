"""The logarithm of the light at pixels, linear in what is asked of light and tissue."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from endotwin.light import shading
from endotwin.light.forward import Lit
from endotwin.pixels.start import ALBEDO_MIDDLE, PRIOR

DARKEST = -20.0
"""Logarithm of light that counts as none."""

TISSUE_MEAN = (1.0, math.log(shading.F0_DIELECTRIC / ALBEDO_MIDDLE), shading.ROUGHNESS_TISSUE)
TISSUE_BOUNDS = ((0.0, math.log(0.02 / 0.9), 0.15), (2.0, math.log(0.05 / 0.25), 0.7))
"""Retro-reflection from Lambert's lobe to that of Burley's roughest tissue; f0 from water's to more than
a dielectric's, on pale tissue and on dark; no mirror and no chalk."""

LIGHT_COLUMNS = 6
"""Of light and tissue: γn, γq, γ, and three of the tissue's answer."""

ASIDE = 0.02
"""Roughness by which its derivative is taken."""


@dataclass(frozen=True)
class Bounced:
    """Indirect irradiance at a probe's pixels, for L0 = 1.

    Attributes:
        log: float32 [N], at the priors of n and q. by_n, by_q: float32 [N], its derivatives by the light's
            n and q.
    """

    log: np.ndarray
    by_n: np.ndarray
    by_q: np.ndarray

    def __getitem__(self, rows: np.ndarray) -> Bounced:
        return Bounced(self.log[rows], self.by_n[rows], self.by_q[rows])

    def at(self, n: float, q: float) -> np.ndarray:
        """ln of the irradiance [N] under another n and q, to first order about their priors."""
        return self.log + (n - PRIOR["n"]) * self.by_n + (q - PRIOR["q"]) * self.by_q


@dataclass(frozen=True)
class Tissue:
    """How all tissue answers light, beside its colour.

    Attributes:
        retro: power of Burley's diffuse lobe at the usual roughness; with 0 it is Lambert's.
        log_gloss: ln of f0 over the median albedo. roughness: of the specular lobe.
    """

    retro: float = TISSUE_MEAN[0]
    log_gloss: float = TISSUE_MEAN[1]
    roughness: float = TISSUE_MEAN[2]

    def moved(self, change: np.ndarray) -> Tissue:
        """Changed by so much [3], within TISSUE_BOUNDS."""
        return Tissue(*map(float, np.clip(np.add(self.values, change), *TISSUE_BOUNDS)))

    @property
    def at_bounds(self) -> np.ndarray:
        """Bool [3]: what would be less or more than any tissue's."""
        return np.isin(self.values, TISSUE_BOUNDS)

    @property
    def values(self) -> tuple[float, float, float]:
        return self.retro, self.log_gloss, self.roughness


@dataclass(frozen=True)
class About:
    """Where a model is linearised: exponents of the light, answer of the tissue, and albedo of the vertices
    [count] over that of the median pixel; None: all alike."""

    n: float = PRIOR["n"]
    q: float = PRIOR["q"]
    tissue: Tissue = Tissue()
    albedo: np.ndarray | None = None


@dataclass(frozen=True)
class LogLight:
    """ln Σ light·answer at N pixels, as a function of n, q and the tissue's answer.

    Attributes:
        lit: by K guides. bounced: what comes from other tissue.
    """

    lit: Lit
    bounced: Bounced | None

    @cached_property
    def log_cos(self) -> np.ndarray:
        """ln of each guide's share n·ωi / K, [N, K]."""
        cos_i = self.lit.guides.cos_i.numpy()
        return np.log(np.maximum(cos_i / cos_i.shape[1], math.exp(DARKEST)))

    @cached_property
    def log_burley(self) -> np.ndarray:
        """ln of the diffuse lobe where tissue is as rough as usual, over Lambert's, [N, K]."""
        guides, roughness = self.lit.guides, torch.tensor(shading.ROUGHNESS_TISSUE)
        lobe = shading.burley(guides.cos_i, self.lit.cos_o[:, None], guides.cos_d, roughness)
        return lobe.log().numpy()

    def irradiance(self, n: float, q: float) -> np.ndarray:
        """[N], of all guides together with L0 = 1."""
        guides = self.lit.guides
        return np.exp(self.log_cos + n * guides.log_axis.numpy() - q * guides.log_distance.numpy()).sum(
            axis=1
        )

    def columns(self, about: About, vertex: np.ndarray) -> np.ndarray:
        """Columns [N, 6] at places of vertices [N], linearised; their coefficients are γn, γq, γ, and γ times
        what retro, log_gloss and roughness of the tissue are more than ``about`` has them. Where light
        bounces there is a seventh: of γ times the change of the bounce's ln."""
        n, q, tissue = about.n, about.q, about.tissue
        axis, distance = self.lit.guides.log_axis.numpy(), self.lit.guides.log_distance.numpy()
        lobe, by_roughness = self._lobe(tissue.roughness)
        albedo = 1.0 if about.albedo is None else about.albedo[vertex, None]
        shine = math.pi * math.exp(tissue.log_gloss) / albedo * lobe
        answer = np.exp(tissue.retro * self.log_burley) + shine
        shine = shine / answer
        terms = self.log_cos + n * axis - q * distance + np.log(answer)
        slopes = [axis, -distance, (1 - shine) * self.log_burley, shine, shine * by_roughness]
        if self.bounced is not None:
            terms = np.c_[terms, self.bounced.at(n, q)]
        top = terms.max(axis=1, keepdims=True)
        share = np.exp(terms - top)
        total = np.einsum("nk->n", share)
        share /= total[:, None]
        guides = share[:, : axis.shape[1]]
        by_n, by_q, *by_tissue = (np.einsum("nk,nk->n", guides, slope) for slope in slopes)
        if self.bounced is not None:
            by_n += share[:, -1] * self.bounced.by_n
            by_q += share[:, -1] * self.bounced.by_q
        by_bounce = [] if self.bounced is None else [share[:, -1]]
        level = top[:, 0] + np.log(total)
        return np.stack([by_n, by_q, level - n * by_n - q * by_q, *by_tissue, *by_bounce], axis=1)

    def _lobe(self, roughness: float) -> tuple[np.ndarray, np.ndarray]:
        """The specular lobe [N, K] per unit of f0, and the derivative of its logarithm by roughness."""
        guides = self.lit.guides

        def at(roughness: float) -> np.ndarray:
            rough = torch.tensor(roughness)
            return shading.specular_lobe(guides.cos_i, self.lit.cos_o[:, None], guides.sin2_m, rough).numpy()

        less, more = (np.log(at(roughness + aside)) for aside in (-ASIDE, ASIDE))
        return at(roughness), (more - less) / (2 * ASIDE)

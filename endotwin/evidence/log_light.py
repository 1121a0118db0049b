"""The logarithm of the light at pixels, linear in what is asked of light and tissue."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

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

LEAST_COS = 0.02
"""By so much normals err: what turns no more to a guide answers as if it turned so much to it."""


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
class Terms:
    """What tissue at N pixels sends to the camera of the light of K guides, in logarithms, of M sets of them
    or of one.

    Attributes:
        axis, distance: as in ``Guided``, [K, (M,) N]. answer: what tissue sends on, over Lambert's.
        by_tissue: derivatives of that by retro, log_gloss and roughness, [3, K, (M,) N].
    """

    axis: np.ndarray
    distance: np.ndarray
    answer: np.ndarray
    by_tissue: np.ndarray

    def of(self, sets: np.ndarray) -> Terms:
        """Those of ``sets`` [K, M] of the guides."""
        return Terms(self.axis[sets], self.distance[sets], self.answer[sets], self.by_tissue[:, sets])

    def columns(self, log_cos: np.ndarray, about: About, bounced: Bounced | None) -> np.ndarray:
        """Columns [(M,) N, 6], linearised; their coefficients are γn, γq, γ, and γ times what retro,
        log_gloss and roughness of the tissue are more than ``about`` has them. Where light is ``bounced``
        there is a seventh: of γ times the change of the bounce's ln. ``log_cos`` as of ``log_cos``."""
        n, q = about.n, about.q
        terms = log_cos + n * self.axis - q * self.distance + self.answer
        top = terms.max(axis=0)
        if bounced is not None:
            among = bounced.at(n, q)
            top = np.maximum(top, among)
        shares = np.exp(terms - top)
        total = shares.sum(axis=0)
        if bounced is not None:
            by_bounce = np.exp(among - top)
            total += by_bounce
            by_bounce /= total
        shares /= total
        slopes = (self.axis, -self.distance, *self.by_tissue)
        by_n, by_q, *by_tissue = (np.einsum("k...,k...->...", shares, slope) for slope in slopes)
        if bounced is not None:
            by_n += by_bounce * bounced.by_n
            by_q += by_bounce * bounced.by_q
        level = top + np.log(total) - n * by_n - q * by_q
        columns = [by_n, by_q, level, *by_tissue, *([] if bounced is None else [by_bounce])]
        return np.moveaxis(np.stack(columns), 0, -1)


def log_cos(cos_i: np.ndarray) -> np.ndarray:
    """ln of each guide's share n·ωi / K, of its n·ωi [K, (M,) N]; 0 in shadow."""
    return np.log(np.maximum(cos_i / np.float32(len(cos_i)), np.float32(math.exp(DARKEST))))


@dataclass(frozen=True)
class LogLight:
    """ln Σ light·answer at N pixels, as a function of n, q and the tissue's answer.

    Attributes:
        lit: by K guides, shadows or not. cos_i: n·ωi of those that the pixels see, float32 [K, N].
        bounced: what comes from other tissue.
    """

    lit: Lit
    cos_i: np.ndarray
    bounced: Bounced | None

    @cached_property
    def log_cos(self) -> np.ndarray:
        """ln of each guide's share n·ωi / K, [N, K]."""
        return log_cos(self.cos_i).T

    @cached_property
    def log_burley(self) -> np.ndarray:
        """ln of the diffuse lobe where tissue is as rough as usual, over Lambert's, [N, K]."""
        cos_d, roughness = self.lit.guides.cos_d, torch.tensor(shading.ROUGHNESS_TISSUE)
        return shading.burley(self._cos_i, self.lit.cos_o[:, None], cos_d, roughness).log().numpy()

    @cached_property
    def _cos_i(self) -> Tensor:
        return self.lit.guides.cos_i.clamp_min(LEAST_COS)

    def irradiance(self, n: float, q: float) -> np.ndarray:
        """[N], of all guides together with L0 = 1."""
        guides = self.lit.guides
        return np.exp(self.log_cos + n * guides.log_axis.numpy() - q * guides.log_distance.numpy()).sum(
            axis=1
        )

    def columns(self, about: About, vertex: np.ndarray) -> np.ndarray:
        """``Terms.columns`` at places of vertices [N]."""
        return self.terms(about, vertex).columns(self.log_cos.T, about, self.bounced)

    def terms(self, about: About, vertex: np.ndarray) -> Terms:
        """What tissue at places of vertices [N] makes of light that is in no shadow."""
        guides, tissue, log_burley = self.lit.guides, about.tissue, self.log_burley.T
        lobe, by_roughness = self._lobe(tissue.roughness)
        gloss = np.float32(math.pi * math.exp(tissue.log_gloss))
        shine = lobe * (gloss if about.albedo is None else gloss / about.albedo[vertex])
        whole = np.exp(tissue.retro * log_burley) + shine
        shine = shine / whole
        by_tissue = np.stack([(1 - shine) * log_burley, shine, shine * by_roughness])
        return Terms(guides.log_axis.numpy().T, guides.log_distance.numpy().T, np.log(whole), by_tissue)

    def _lobe(self, roughness: float) -> tuple[np.ndarray, np.ndarray]:
        """The specular lobe [K, N] per unit of f0, and the derivative of its logarithm by roughness."""
        cos_o, sin2_m = self.lit.cos_o[:, None], self.lit.guides.sin2_m

        def at(roughness: float) -> np.ndarray:
            return shading.specular_lobe(self._cos_i, cos_o, sin2_m, torch.tensor(roughness)).numpy().T

        less, more = (np.log(at(roughness + aside)) for aside in (-ASIDE, ASIDE))
        return at(roughness), (more - less) / (2 * ASIDE)

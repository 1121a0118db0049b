"""The probe: which model of light leaves less of the photos unexplained, on pixels that it was not fitted to.

Where tissue is diffuse, ln C = γ·(ln b + ln Σ light) with one unknown albedo b a vertex. Taking out each
vertex's mean leaves a linear regression in γn, γq and γ, whatever the light is made of; it takes
milliseconds. Half of the vertices choose the coefficients, the other half judges them, then the halves
change places.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch

from endotwin.effects.vignetting import squared_radius
from endotwin.light.guides import AT_LENS, COSINE, guided, log_axis, visible_from
from endotwin.pixels.fixed_effects import Design, FixedEffects, regress, robust_losses, robust_residuals
from endotwin.pixels.start import LIGHT_MEAN, LIGHT_SPREAD, PRIOR, diffuse
from endotwin.surface.vectors import unit

if TYPE_CHECKING:
    from endotwin.pixels.samples import Samples
    from endotwin.surface.casting import Caster
    from endotwin.twin import Twin

PIXELS = 24_000
LEAST_PIXELS = 4
"""A vertex takes part if so many pixels show it: one gives its albedo, the others judge."""

DARKEST = -20.0
"""Logarithm of light that counts as none."""

MIN_GAIN_DB = 0.2
MIN_SIGMAS = 3.0
"""An effect is kept where it lowers the held-out error by so much, and by so many of its uncertainties."""

MIN_IMPOSSIBLE_DB = 3.0
"""What it takes if γ, n or q are then such as no endoscope has: the model of light may lack something, and
the effect be there all the same."""

VIGNETTING_SPREAD = 0.1
"""Prior standard deviation of γ·k2 about 0. Like that of γn, γq and γ it counts against one
observation a vertex: what the model lacks errs alike in all pixels of one."""

POSSIBLE = ((0.1, 2.0), (-1.0, 12.0), (-0.5, 7.0))
"""Bounds of γ, n and q, with room for their errors: beyond, few pixels were explained by many things."""

HINT_DB, HINT_SIGMAS = 0.1, 2.0
"""What is worth a longer look, which then has to be worth keeping."""


@dataclass(frozen=True)
class Bounced:
    """Indirect irradiance at a probe's pixels, for L0 = 1.

    Attributes:
        log: float32 [N], at the priors of n and q. by_n, by_q: float32 [N], its derivatives by the light's
            n and q.
        L0: of a light under which tissue of the usual albedo looks as bright as in the photos.
    """

    log: np.ndarray
    by_n: np.ndarray
    by_q: np.ndarray
    L0: float

    def __getitem__(self, rows: np.ndarray) -> Bounced:
        return Bounced(self.log[rows], self.by_n[rows], self.by_q[rows], self.L0)

    def at(self, n: float, q: float) -> np.ndarray:
        """ln of the irradiance [N] under another n and q, to first order about their priors."""
        return self.log + (n - PRIOR["n"]) * self.by_n + (q - PRIOR["q"]) * self.by_q


@dataclass(frozen=True)
class Hypothesis:
    """A model of the light: which effects it has."""

    guides_mm: tuple[tuple[float, float, float], ...] = AT_LENS
    shadows: bool = False
    profile: float = COSINE
    gain: bool = False
    vignetting: bool = False
    bounced: Bounced | None = None


@dataclass(frozen=True)
class Verdict:
    """By how much one hypothesis predicts unseen pixels better than another: dB, and in its own sigmas; and
    whether light and response of the better one are any endoscope's, or the other's neither."""

    gain_db: float
    sigmas: float
    possible: bool = True

    @property
    def keep(self) -> bool:
        return self.worth(Verdict(MIN_GAIN_DB, MIN_SIGMAS))

    @property
    def hints(self) -> bool:
        return self.gain_db >= HINT_DB and self.sigmas >= HINT_SIGMAS

    def worth(self, least: Verdict) -> bool:
        """Whether both its numbers are at least those of ``least``, and what is possible or else plain."""
        least_db = least.gain_db if self.possible else MIN_IMPOSSIBLE_DB
        return self.gain_db >= least_db and self.sigmas >= least.sigmas

    def __str__(self) -> str:
        impossible = "" if self.possible else ", but with a light that no endoscope has"
        return f"{self.gain_db:+.2f} dB, {self.sigmas:.0f} sigmas{impossible}"


@dataclass(frozen=True)
class Fitted:
    """A hypothesis with its coefficients, and the design that they belong to."""

    hypothesis: Hypothesis
    design: Design
    effects: FixedEffects

    @property
    def gamma(self) -> float:
        return float(self.effects.coefficients[2])

    @property
    def log_gain(self) -> np.ndarray:
        """ln of each frame's gain, float64 [F]; 0 in the first."""
        return self.effects.intercepts / self.start[2]

    @property
    def n(self) -> float:
        return float(self.effects.coefficients[0] / self.effects.coefficients[2])

    @property
    def q(self) -> float:
        return float(self.effects.coefficients[1] / self.effects.coefficients[2])

    @property
    def possible(self) -> bool:
        """Whether γ, n and q are such as an endoscope may have."""
        (least, most), *bounds = POSSIBLE
        if not least < self.gamma < most:  # it is 0 where all photos are white, and n and q are 0/0
            return False
        return all(low < value < high for value, (low, high) in zip((self.n, self.q), bounds, strict=True))

    @property
    def start(self) -> tuple[float, float, float]:
        """n, q and γ to start a fit from: those of the priors, where its own are no endoscope's."""
        return (self.n, self.q, self.gamma) if self.possible else (PRIOR["n"], PRIOR["q"], PRIOR["gamma"])


class Probe:
    """Pixels of some vertices, all that each of them shows, and hypotheses about their light.

    Attributes:
        samples: the pixels. vertex: int [N], numbered without gaps.
    """

    def __init__(self, samples: Samples, twin: Twin, caster: Caster, pixels: int = PIXELS, seed: int = 0):
        surface = twin.surface
        self.twin, self.caster = twin, caster
        generator = np.random.default_rng(seed)
        rows = np.flatnonzero(diffuse(samples))
        vertex = samples.nearest(surface.triangles)[rows]
        chosen = _whole_groups(vertex, len(surface.vertices_mm), pixels, generator)
        self._rows = rows[chosen]
        self.samples = samples[torch.from_numpy(self._rows)]
        self.vertex = np.unique(vertex[chosen], return_inverse=True)[1].reshape(-1)
        self.count = int(self.vertex.max(initial=-1)) + 1
        self._half = (generator.random(self.count) < 0.5)[self.vertex]
        self.target = np.log(self.samples.color.numpy().mean(axis=1, dtype=np.float64) / 255)

    def __len__(self) -> int:
        return len(self.target)

    def part(self, pixels: int) -> tuple[Probe, np.ndarray]:
        """A probe of about so many of these pixels, all of some vertices; and which, int [M]."""
        part = Probe(self.samples, self.twin, self.caster, pixels)
        return part, part._rows

    @cached_property
    def frames(self) -> np.ndarray:
        """The frames that the pixels come from, ascending."""
        return np.unique(self.samples.frame.numpy())

    @cached_property
    def frame(self) -> np.ndarray:
        """Position of each pixel's frame in ``frames``, int [N]."""
        return np.searchsorted(self.frames, self.samples.frame.numpy())

    @cached_property
    def T_local_camera(self) -> np.ndarray:
        """Poses of ``frames`` in the surface's frame, float64 [F, 4, 4]."""
        views = self.samples.views
        return views.T_local_camera[np.searchsorted(views.frames, self.frames)]

    @cached_property
    def points_mm(self) -> np.ndarray:
        """Surface points in the camera frame, float32 [N, 3]."""
        local = self.local_points_mm - self.T_local_camera[self.frame, :3, 3]
        return np.einsum("nba,nb->na", self.T_local_camera[self.frame, :3, :3], local).astype(np.float32)

    @cached_property
    def normals(self) -> np.ndarray:
        """Unit normals in the camera frame, float32 [N, 3]."""
        turned = np.einsum("nba,nb->na", self.T_local_camera[self.frame, :3, :3], self.local_normals)
        return unit(turned.astype(np.float32))

    @cached_property
    def local_points_mm(self) -> np.ndarray:
        """Surface points in the surface's frame, float32 [N, 3]."""
        return self._interpolated(self.twin.surface.vertices_mm)

    @cached_property
    def local_normals(self) -> np.ndarray:
        """Normals in the surface's frame, float32 [N, 3]."""
        return self._interpolated(self.twin.surface.normals)

    def visible(self, guide_mm: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Bool [N]: whether a guide [3] (camera frame) sees each pixel's point (or of those in ``rows``)."""
        rows = np.arange(len(self)) if rows is None else rows
        seen = np.empty(len(rows), bool)
        order = np.argsort(self.frame[rows], kind="stable")
        bounds = np.searchsorted(self.frame[rows][order], np.arange(len(self.frames) + 1))
        for number, pose in enumerate(self.T_local_camera):
            part = order[bounds[number] : bounds[number + 1]]
            points_mm = self.points_mm[rows[part]]
            seen[part] = visible_from(self.caster, pose, points_mm, guide_mm[None])[:, 0] > 0
        return seen

    def direct_light(self, hypothesis: Hypothesis, n: float, q: float) -> np.ndarray:
        """Irradiance [N] of the pixels' points under the hypothesis's guides with L0 = 1."""
        light = self._light(hypothesis)
        return np.exp(light.log_cos + n * light.log_axis - q * light.log_distance).sum(axis=1)

    def fit(self, hypothesis: Hypothesis, n: float = PRIOR["n"], q: float = PRIOR["q"]) -> Fitted:
        """The hypothesis with coefficients from all pixels; linearised about ``n`` and ``q``, twice if need
        be."""
        linear = hypothesis.guides_mm == AT_LENS and hypothesis.bounced is None
        light = self._light(hypothesis)
        for _ in range(1 if linear else 2):
            found = self._fitted(hypothesis, self._design(hypothesis, light.columns(n, q)))
            if found.gamma > 0.05:
                n, q = found.n, found.q
        return found

    def residuals(
        self, hypothesis: Hypothesis, base: Fitted, visible: np.ndarray | None = None
    ) -> np.ndarray:
        """Robust residuals [N], in widths of those of ``base``, linearised about it, under guides that see
        the pixels as ``visible`` [N, K] says (found out unless given)."""
        design = self._design(hypothesis, self._light(hypothesis, visible).columns(base.n, base.q))
        found = regress(self.target, design, len(self.frames), rounds=2)
        return robust_residuals(self.target, design, found, base.effects.width)

    def compare(self, base: Fitted, other: Fitted) -> Verdict:
        """How much better ``other`` predicts pixels of vertices that did not choose its coefficients."""
        designs = base.design, other.design
        verdict = compared(self.target, *designs, self._half, base.effects.width, len(self.frames))
        return replace(verdict, possible=other.possible or not base.possible)

    def _fitted(self, hypothesis: Hypothesis, design: Design) -> Fitted:
        return Fitted(hypothesis, design, regress(self.target, design, len(self.frames)))

    def _design(self, hypothesis: Hypothesis, columns: np.ndarray) -> Design:
        mean, spread = list(LIGHT_MEAN), list(LIGHT_SPREAD)
        if hypothesis.vignetting:
            columns = np.c_[columns, self.vignetting_column]
            mean, spread = [*mean, 0.0], [*spread, VIGNETTING_SPREAD]
        precision = len(self) / max(self.count, 1) / np.square(spread)
        prior = np.diag(precision), precision * mean
        return Design(columns, self.vertex, self.count, self.frame if hypothesis.gain else None, prior=prior)

    def _interpolated(self, per_vertex: np.ndarray) -> np.ndarray:
        corners = per_vertex[self.twin.surface.triangles[self.samples.triangle.numpy()]]
        return np.einsum("nk,nka->na", self.samples.barycentric.numpy(), corners)

    def _light(self, hypothesis: Hypothesis, visible: np.ndarray | None = None) -> LogLight:
        if hypothesis.guides_mm == AT_LENS:
            cos, log_distance = self.samples.cos.numpy()[:, None], self.samples.log_distance.numpy()[:, None]
            axis = self.samples.log_cos_axis.numpy()[:, None]
            if hypothesis.profile != COSINE:
                axis = log_axis(np.exp(axis), hypothesis.profile)
        else:
            guides_mm = np.asarray(hypothesis.guides_mm, np.float32)
            if hypothesis.shadows and visible is None:
                visible = np.stack([self.visible(guide) for guide in guides_mm], axis=1)
            lit = guided(self.points_mm, self.normals, guides_mm, hypothesis.profile, visible)
            cos, axis, log_distance = (value.numpy() for value in (lit.cos_i, lit.log_axis, lit.log_distance))
        log_cos = np.log(np.maximum(cos / cos.shape[1], math.exp(DARKEST)))
        return LogLight(log_cos, axis, log_distance, hypothesis.bounced)

    @cached_property
    def vignetting_column(self) -> np.ndarray:
        """r² of each pixel, r = 1 at the middle of the image's longer side, [N]. No r⁴ beside it: light of
        another exponent n is darker towards the rim in nearly the same way, and would lose its n to both."""
        return squared_radius(self.twin.camera, self.samples.pixel.numpy())


def compared(
    target: np.ndarray, base: Design, other: Design, half: np.ndarray, width: float, categories: int = 0
) -> Verdict:
    """How much better ``other`` explains values of groups that did not choose its coefficients.

    Args:
        target: [N]. half: bool [N], of whole groups: each half chooses for the other. width: of the loss.
        categories: number of the designs' categories.
    """
    before, after = (_held_out(target, design, half, width, categories) for design in (base, other))
    gained = np.bincount(base.group, before - after, base.count)
    sigma = max(math.sqrt(float((gained**2).sum())), 1e-30)
    ratio = before.sum() / max(float(after.sum()), 1e-30)
    return Verdict(10 * math.log10(max(ratio, 1e-30)), float(gained.sum()) / sigma)


def _held_out(
    target: np.ndarray, design: Design, half: np.ndarray, width: float, categories: int
) -> np.ndarray:
    losses = np.zeros(len(target))
    for part in (half, ~half):
        found = regress(target[part], design[part], categories)
        losses[~part] = robust_losses(target[~part], design[~part], found, width)
    return losses


@dataclass(frozen=True)
class LogLight:
    """ln Σ light at N pixels, as a function of n and q.

    Attributes:
        log_cos, log_axis, log_distance: float [N, K], of each guide. bounced: what comes from other tissue.
    """

    log_cos: np.ndarray
    log_axis: np.ndarray
    log_distance: np.ndarray
    bounced: Bounced | None

    def columns(self, n: float, q: float) -> np.ndarray:
        """Columns [N, 3] whose coefficients are γn, γq and γ, linearised about n and q (exact for one
        lamp)."""
        terms = self.log_cos + n * self.log_axis - q * self.log_distance
        by_n, by_q = self.log_axis, -self.log_distance
        if self.bounced is not None:
            terms = np.c_[terms, self.bounced.at(n, q)]
            by_n, by_q = np.c_[by_n, self.bounced.by_n], np.c_[by_q, self.bounced.by_q]
        top = terms.max(axis=1, keepdims=True)
        share = np.exp(terms - top)
        total = share.sum(axis=1, keepdims=True)
        share /= total
        by_n, by_q = (share * by_n).sum(axis=1), (share * by_q).sum(axis=1)
        level = (top + np.log(total))[:, 0]
        return np.stack([by_n, by_q, level - n * by_n - q * by_q], axis=1)


def _whole_groups(group: np.ndarray, count: int, wanted: int, generator: np.random.Generator) -> np.ndarray:
    """Rows of whole groups, drawn at random until ``wanted`` rows are there; groups with few rows are left
    out."""
    size = np.bincount(group, minlength=count)
    order = generator.permutation(np.flatnonzero(size >= LEAST_PIXELS))
    taken = np.zeros(count, bool)
    taken[order[: int(np.searchsorted(np.cumsum(size[order]), wanted)) + 1]] = True
    return np.flatnonzero(taken[group])

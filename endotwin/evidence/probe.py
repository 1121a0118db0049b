"""The probe: which model of light leaves less of the photos unexplained, on pixels that it was not fitted to.

ln C = γ·(ln b + ln Σ light·answer) with one unknown albedo b a vertex, and an answer of the tissue that is
nearly 1 where it is diffuse. Taking out each vertex's mean leaves a linear regression in γn, γq and γ,
whatever the light is made of; it takes milliseconds. Half of the vertices choose the coefficients, the other
half judges them, then the halves change places.

How tissue answers light beside its colour is part of every model: a rough lobe reaches far beyond the
highlights that are left out, and retro-reflection far from the rim. What a model lacks there, guides,
vignetting and a gain would explain, none of which is there.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch

from endotwin.effects.noise import LEVEL
from endotwin.evidence.log_light import (
    LEAST_COS,
    LIGHT_COLUMNS,
    TISSUE_MEAN,
    About,
    Bounced,
    LogLight,
    Tissue,
    log_cos,
)
from endotwin.evidence.sightings import Sightings
from endotwin.evidence.verdict import Halved, Verdict, compared, verdict_of
from endotwin.light.forward import Lit
from endotwin.light.guides import AT_LENS, COSINE, guided, log_axis
from endotwin.pixels.fixed_effects import Design, FixedEffects, Left, pseudo_huber, regress, without_means
from endotwin.pixels.samples import Samples, whole_groups
from endotwin.pixels.start import LIGHT_MEAN, LIGHT_SPREAD, PRIOR, VIGNETTING_SPREAD, dark, diffuse

if TYPE_CHECKING:
    from endotwin.surface.casting import Caster
    from endotwin.twin import Twin

PIXELS = 24_000
LEAST_PIXELS = 4
"""A vertex takes part if so many pixels show it: one gives its albedo, the others judge."""

TISSUE_SPREAD = (0.7, 0.7, 0.1)
"""Prior of the tissue's answer to light, see ``Tissue``: from Lambert's lobe to one rougher than usual; f0
and albedo of half or twice what they mostly are. Like that of γn, γq, γ and γ·k2 it counts against one
observation a vertex: what the model lacks errs alike in all pixels of one."""

ALBEDO_RANGE = 5.0
"""Albedos are told to within this factor of the median: enough for how much their lobes stand out."""

UNEVEN_SPREAD = 0.3
"""Prior of ln of a frame's own bounce, and of what drifts along the path: what a bounce was found to err by
between frames is a third of that at most, so that the photos tell it."""

HELD = 1e-6
"""Spread of what is not to move."""

ROUNDS = 3
"""In which a model is linearised about what it was found to be."""

POSSIBLE = ((0.1, 2.0), (-1.0, 12.0), (-0.5, 7.0))
"""Bounds of γ, n and q, with room for their errors: beyond, few pixels were explained by many things."""

LEAST_GAMMA = 0.05
"""Less is found where photos tell nothing: a model is not linearised about that."""


@dataclass(frozen=True)
class Hypothesis:
    """A model of the light: which effects it has.

    Attributes:
        uneven: whether bounced light is of another strength in each frame, as no scene's is, but what stands
            for it may be. adrift: whether its strength, and that of all light, change along the path.
    """

    guides_mm: tuple[tuple[float, float, float], ...] = AT_LENS
    shadows: bool = False
    profile: float = COSINE
    gain: bool = False
    vignetting: bool = False
    bounced: Bounced | None = None
    uneven: bool = False
    adrift: bool = False


@dataclass(frozen=True, eq=False)
class Fitted:
    """A hypothesis with its coefficients, the design that they belong to, and where that is linearised.

    Attributes:
        target: [N], what it explains. half: bool [N], of whole vertices: each half chooses for the other.
    """

    hypothesis: Hypothesis
    design: Design
    effects: FixedEffects
    about: About
    target: np.ndarray
    half: np.ndarray

    @cached_property
    def halved(self) -> Halved:
        """The design with the coefficients that either half of the vertices chooses."""
        return Halved.of(self.target, self.design, self.half, len(self.effects.intercepts))

    @property
    def near(self) -> About:
        """Where models that are near this one are linearised."""
        return self.about if self.possible else About()

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
    def tissue(self) -> Tissue:
        return self.about.tissue.moved(self.effects.coefficients[3:6] / self.gamma)

    @property
    def vignetting(self) -> float:
        """k2; of a hypothesis that has vignetting."""
        return float(self.effects.coefficients[6] / self.start[2])

    @property
    def possible(self) -> bool:
        """Whether γ, n and q are such as an endoscope may have."""
        (least, most), *bounds = POSSIBLE
        if not least < self.gamma < most:  # it is 0 where all photos are white, and n and q are 0/0
            return False
        return all(low < value < high for value, (low, high) in zip((self.n, self.q), bounds, strict=True))

    @property
    def unusual(self) -> float:
        """How unlikely its light and response are by their prior, in nats from its mean."""
        off = (self.effects.coefficients[:3] - LIGHT_MEAN) / LIGHT_SPREAD
        return float(off @ off) / 2

    @property
    def start(self) -> tuple[float, float, float]:
        """n, q and γ to start a fit from: those of the priors, where its own are no endoscope's."""
        return (self.n, self.q, self.gamma) if self.possible else (PRIOR["n"], PRIOR["q"], PRIOR["gamma"])


class Probe(Sightings):
    """Sightings of some vertices, all that tell their light, and hypotheses about it.

    Attributes:
        count: number of the vertices. half: bool [N], of whole vertices, drawn by chance. dark: other
            sightings of the vertices, that show no light.
    """

    def __init__(self, samples: Samples, twin: Twin, caster: Caster, pixels: int = PIXELS, seed: int = 0):
        surface, self._every = twin.surface, samples
        generator = np.random.default_rng(seed)
        rows, every = np.flatnonzero(diffuse(samples)), samples.nearest(surface.triangles)
        chosen = whole_groups(every[rows], len(surface.vertices_mm), pixels, generator, LEAST_PIXELS)
        self._rows = rows[chosen]
        known, vertex = np.unique(every[self._rows], return_inverse=True)
        super().__init__(samples[torch.from_numpy(self._rows)], vertex.reshape(-1), twin, caster)
        self.count = len(known)
        self.half = (generator.random(self.count) < 0.5)[self.vertex]
        self.target = np.log(self.shown)
        rows = np.flatnonzero(dark(samples) & np.isin(every, known))
        rows = rows[np.isin(samples.frame.numpy()[rows], self.frames)]
        numbers = np.searchsorted(known, every[rows])
        self.dark = Sightings(samples[torch.from_numpy(rows)], numbers, twin, caster)

    @property
    def pixels_a_place(self) -> float:
        """How many there are of a vertex, in the mean."""
        return len(self) / max(self.count, 1)

    def part(self, pixels: int) -> tuple[Probe, np.ndarray]:
        """A probe of about so many of these pixels, all of some vertices; and which, int [M]."""
        part = Probe(self.samples, self.twin, self.caster, pixels)
        return part, part._rows

    def direct_light(self, hypothesis: Hypothesis, n: float, q: float) -> np.ndarray:
        """Irradiance [N] of the pixels' points under the hypothesis's guides with L0 = 1."""
        return log_light(self, hypothesis).irradiance(n, q)

    def fit(self, hypothesis: Hypothesis) -> Fitted:
        """The hypothesis with coefficients from all pixels; linearised about what it was found to be."""
        light, about = log_light(self, hypothesis), About()
        for number in range(ROUNDS):
            held = about.tissue.at_bounds & (number == ROUNDS - 1)
            design = self._design(hypothesis, light, about, held)
            effects = regress(self.target, design, len(self.frames))
            found = Fitted(hypothesis, design, effects, about, self.target, self.half)
            if found.gamma <= LEAST_GAMMA or number == ROUNDS - 1 or not len(self):
                break
            about = About(found.n, found.q, found.tissue, self._albedo(found))
        return found

    def linearised(self, hypothesis: Hypothesis, base: Fitted, visible: np.ndarray | None = None) -> Design:
        """The design of a hypothesis about ``base``, under guides that see the pixels as ``visible`` [N, K]
        says (found out unless given)."""
        about = base.near
        return self._design(hypothesis, log_light(self, hypothesis, visible), about, about.tissue.at_bounds)

    def columns(
        self,
        hypothesis: Hypothesis,
        base: Fitted,
        sets_mm: np.ndarray,
        visible: Callable[[np.ndarray], np.ndarray],
    ) -> np.ndarray:
        """Columns [M, N, C] of ``linearised`` designs with other guides, M sets of K [M, K, 3]; any guides
        [U, 3] see the pixels as ``visible`` says, [N, U]. What a guide does that is in several sets is found
        out once."""
        guides_mm, sets = np.unique(sets_mm.reshape(-1, 3), axis=0, return_inverse=True)
        sets = sets.reshape(sets_mm.shape[:2]).T
        lit, about = _lit(self, guides_mm, hypothesis.profile), base.near
        cos_i = lit.guides.cos_i.numpy().T
        terms = LogLight(lit, cos_i, None).terms(about, self.vertex).of(sets)
        cos_i = shown_to(cos_i[sets], visible(guides_mm).T[sets], hypothesis.bounced is None)
        return _beside(self, hypothesis, terms.columns(log_cos(cos_i), about, hypothesis.bounced))

    def left(self, design: Design, base: Fitted) -> Left:
        """What a design leaves of the pixels, in widths of what ``base`` does."""
        return Left.of(self.target, design, base.effects.width, len(self.frames))

    def compare(self, base: Fitted, other: Fitted) -> Verdict:
        """How much better ``other`` predicts pixels of vertices that did not choose its coefficients."""
        verdict = compared(base.halved, other.halved, base.effects.width)
        possible = other.possible or not base.possible
        likelier = base.unusual - other.unusual if other.possible else 0.0
        return replace(verdict, possible=possible, likelier=likelier)

    def better(self, base: Fitted, other: Fitted) -> Fitted:
        """``other`` where it predicts pixels of vertices that did not choose its coefficients better."""
        return other if self.compare(base, other).gain_db > 0 else base

    def shaded_db(self, found: Fitted) -> float:
        """By how much the mean square of what ``found`` leaves would grow if nothing explained the shadows
        of its guides, each a share of the light, in all pixels, of the probe or not."""
        every = Sightings(self._every, np.zeros(len(self._every), int), self.twin, self.caster)
        lost = 1 - every.visible(found.hypothesis.guides_mm).mean(axis=1)
        return 10 * math.log10(1 + float(((found.gamma * lost) ** 2).mean()) / found.effects.width**2)

    def told_by_shadows(self, cast: Fitted, uncast: Fitted) -> Verdict:
        """How much better ``cast`` shows the photos than ``uncast``, the same without shadows.

        A pixel that shows light lies in no full shadow, so that those which do tell nothing of it: the dark
        ones count here, too, and all as they look.
        """
        if cast.hypothesis.bounced is not None:
            return self.compare(uncast, cast)
        scale = uncast.effects.width * float(np.median(self.shown))
        gained, after = np.zeros(self.count), 0.0
        for part in (self, self.dark):
            left = [(part.shown - self._predicted(found, part)) / scale for found in (uncast, cast)]
            losses = [pseudo_huber(each) for each in left]
            gained += np.bincount(part.vertex, losses[0] - losses[1], self.count)
            after += float(losses[1].sum())
        return verdict_of(gained, after)

    def _predicted(self, found: Fitted, sightings: Sightings) -> np.ndarray:
        """What the photos show at ``sightings``, [M] in 0 … 1; nothing where no guide is seen."""
        hypothesis = found.hypothesis
        columns = _columns(sightings, hypothesis, log_light(sightings, hypothesis), found.about)
        frame = np.searchsorted(self.frames, sightings.samples.frame.numpy())
        design = Design(columns, sightings.vertex, self.count, frame if hypothesis.gain else None)
        shown = np.exp(design.explained(found.effects) + self._intercepts(found)[sightings.vertex])
        return shown * sightings.lit(hypothesis.guides_mm, hypothesis.shadows)

    def smooth_colors(self, found: Fitted) -> np.ndarray:
        """Display values [N, 3] as ``found`` has the pixels' brightness, each place of one hue."""
        log_color = np.log(self.shown_colors)
        left = log_color - found.design.explained(found.effects)[:, None]
        left = without_means(left, np.ones(len(self)), self.vertex, self.count)
        return np.clip(np.exp(log_color - left), LEVEL, 1)

    def _intercepts(self, found: Fitted) -> np.ndarray:
        """What is left of ln C at each vertex, [count]."""
        left = self.target - found.design.explained(found.effects)
        return np.bincount(self.vertex, left, self.count) / np.bincount(self.vertex, minlength=self.count)

    def _albedo(self, found: Fitted) -> np.ndarray:
        """Albedo [count] of the vertices over that of the median pixel."""
        log_albedo = self._intercepts(found) / found.gamma
        most = math.log(ALBEDO_RANGE)
        return np.exp(np.clip(log_albedo - np.median(log_albedo[self.vertex]), -most, most))

    def _design(self, hypothesis: Hypothesis, light: LogLight, about: About, held: np.ndarray) -> Design:
        """Linearised; what is ``held`` [3] of the tissue does not move."""
        moved = np.where(held, 0, PRIOR["gamma"] * np.subtract(TISSUE_MEAN, about.tissue.values))
        spread = np.where(held, HELD, np.multiply(PRIOR["gamma"], TISSUE_SPREAD))
        mean, spread = [*LIGHT_MEAN, *moved], [*LIGHT_SPREAD, *spread]
        if hypothesis.vignetting:
            mean, spread = [*mean, 0.0], [*spread, VIGNETTING_SPREAD]
        columns = _columns(self, hypothesis, light, about)
        by_frame = columns.shape[1] - len(mean)
        mean, spread = [*mean, *[0.0] * by_frame], [*spread, *[PRIOR["gamma"] * UNEVEN_SPREAD] * by_frame]
        precision = self.pixels_a_place / np.square(spread)
        return Design(
            columns,
            self.vertex,
            self.count,
            self.frame if hypothesis.gain else None,
            self.trust,
            prior=(np.diag(precision), precision * mean),
        )


def _columns(sightings: Sightings, hypothesis: Hypothesis, light: LogLight, about: About) -> np.ndarray:
    """All those of a design, [N, C]."""
    return _beside(sightings, hypothesis, light.columns(about, sightings.vertex))


def _beside(sightings: Sightings, hypothesis: Hypothesis, columns: np.ndarray) -> np.ndarray:
    """The ``columns`` [..., N, 6 or 7] of the light, with those of vignetting, of each frame's bounce, and of
    what drifts, where there are any."""
    columns, by_bounce = np.split(columns, [LIGHT_COLUMNS], axis=-1)
    parts = [columns]
    if hypothesis.vignetting:
        parts.append(sightings.vignetting_column[:, None])
    if hypothesis.uneven:
        parts.append(by_bounce * (sightings.frame[:, None] == np.arange(len(sightings.frames))))
    if hypothesis.adrift:
        drifts = sightings.drifts[sightings.frame]
        parts += [drifts, by_bounce * drifts]
    return np.concatenate([np.broadcast_to(x, (*columns.shape[:-1], x.shape[-1])) for x in parts], axis=-1)


def log_light(sightings: Sightings, hypothesis: Hypothesis, visible: np.ndarray | None = None) -> LogLight:
    """The light of a hypothesis at sightings that its guides see as ``visible`` [N, K] says (found out unless
    given).

    What shows light is lit, whatever the surface says: see ``shown_to``.
    """
    samples = sightings.samples
    if hypothesis.guides_mm == AT_LENS:
        axis = samples.log_cos_axis
        if hypothesis.profile != COSINE:
            axis = torch.from_numpy(log_axis(axis.exp().numpy(), hypothesis.profile))
        lit = Lit.at_lens(samples.cos, samples.sin2, axis, samples.log_distance)
        return LogLight(lit, lit.guides.cos_i.numpy().T, hypothesis.bounced)
    guides_mm = np.asarray(hypothesis.guides_mm, np.float32)
    if hypothesis.shadows and visible is None:
        visible = sightings.visible(guides_mm)
    lit, seen = _lit(sightings, guides_mm, hypothesis.profile), None if visible is None else visible.T
    cos_i = shown_to(lit.guides.cos_i.numpy().T, seen, hypothesis.bounced is None)
    return LogLight(lit, cos_i, hypothesis.bounced)


def _lit(sightings: Sightings, guides_mm: np.ndarray, profile: float) -> Lit:
    """How guides [K, 3] light sightings without shadows."""
    return Lit(sightings.samples.cos, guided(sightings.points_mm, sightings.normals, guides_mm, profile))


def shown_to(cos_i: np.ndarray, visible: np.ndarray | None, alone: bool) -> np.ndarray:
    """n·ωi [K, ..., N] of the guides that pixels see as ``visible`` says (None: all). Where nothing but them
    lights what shows light, none of that lies in the shadow of all, or turns away from all."""
    if visible is not None:
        cos_i = cos_i * (visible | ~visible.any(axis=0) if alone else visible)
    return np.where(cos_i.max(axis=0) < LEAST_COS, np.float32(LEAST_COS), cos_i) if alone else cos_i

"""Light, response and f0 from what changes while one place of the tissue is looked at.

Each vertex has an albedo that nobody knows. In log C that is an intercept of its own, and subtracting the
vertex's mean takes it out exactly: what is left varies with distance, angle and frame only. Unlike a fit
beside smooth albedo features, no texture can pass for shading, whatever those features cannot follow.

The gain of a frame is an intercept, too. A camera that comes nearer turns its gain down, so that gains pass
for most of the fall-off: found in turns with it, they would stay where they were first guessed. So would
guides, whose places pass for the light's exponents.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.linalg
import torch
from torch import Tensor

from endotwin.effects.coat import Coat
from endotwin.effects.tone import Tone, bend
from endotwin.evidence.coat import LEAST_SIGHTINGS, Highlights
from endotwin.evidence.tone import RATIO_ERROR, RATIOS, Hues
from endotwin.fit.faint import NOTHING, Faint
from endotwin.fit.gauss_newton import TEMPER
from endotwin.fit.model import F0, GLOBALS, Globals, free_directions, linearise, predict
from endotwin.fit.prior import ROUGHNESS_LOGIT_SPREAD, global_prior
from endotwin.fit.state import bounded, roughness_slope
from endotwin.light import shading
from endotwin.pixels.fixed_effects import Design, regress
from endotwin.pixels.samples import Samples
from endotwin.pixels.start import BRIGHT, DARK, DIFFUSE_SIN2, trust
from endotwin.surface import Surface

LEVEL = GLOBALS.index("gamma·ln L0")

DARKEST = 0.03
"""Display value of photo or prediction below which noise rules the logarithm. Where a black shadow is a
little off, neither the side that is too bright nor the one that is too dark tells: either alone would seem to
say that it is too small, or too large."""

MODEL_ERROR = 0.02
"""Relative error of a prediction whose noise is 0, where light meets tissue head-on: distances, albedo within
a vertex's cell."""

COAT_SPREAD = 2.0
"""Standard deviation of a coat's weight about 0: tissue is wet, not lacquered."""

HUE_PIXELS = 100_000
"""Of those that tell a tone curve, all of some vertices."""

HIGHLIGHT_PIXELS = 30_000
"""Of the highlights, all of some vertices; more would not change the mind about a coat."""

FAINT_RIDGE = 0.001
"""What a model lacks errs alike in many pixels: all are worth some thousands that err each for itself. And a
faint effect shows by half of the noise at most, since more would be decided. So much of what pixels say of it
says that it is 0, and none is found that light and response nearly pass for."""

REWEIGHTS = 4

GUIDE_PIXELS = 60_000
"""Of those that tell where guides stand, all of some vertices."""

ASIDE = 0.01
"""Guides are moved to either side by this share of the median viewing distance to find what their places
change: with less, shadows that jump from pixel to pixel hide it."""

ASIDE_SPREAD = 0.02
"""Standard deviation of a step of theirs, as a share of that distance: what the probe leaves open."""


@dataclass(frozen=True)
class Varied:
    """What may change with light and response.

    Attributes:
        frames: how many frames have gains of their own, one after the other as in the samples' views.
        faint: effects that may be there.
        guides: how many may move.
        aside: samples, and mm, to the same ones lit by guides moved so far to either side: each in turn,
            along x, then y and z.
    """

    frames: int = 0
    faint: Faint = NOTHING
    guides: int = 0
    aside: Callable[[Samples, float], Iterator[tuple[Samples, Samples]]] | None = None


STILL = Varied()


@dataclass(frozen=True)
class Renewed:
    """What a step has found: ``shared``, and what it adds to ln of each frame's gain, float64 [frames], to
    the guides' places, float64 [guides, 3], mm, to the logit of all roughness, and to the coefficients of
    faint effects, float64 [K]."""

    shared: Globals
    log_gain: np.ndarray = field(default_factory=lambda: np.zeros(0))
    aside_mm: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    roughness: float = 0.0
    faint: np.ndarray = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class Sightings:
    """What the pixels of a vertex in one photo tell together, S of them.

    Attributes:
        vertex, frame: int [S]. residual: ln photo − ln prediction [S]. slopes: d ln C by the shared
            parameters [S, G]. by_roughness: d ln C by the logit of roughness [S]. by_coat: d ln C by the
            coat's weight [S], 0 without one. by_varied: d ln C by what is ``Varied`` beside gains: the
            guides' places, 1/mm, and coefficients of faint effects [S, V]. weight: inverse variance [S].
    """

    vertex: np.ndarray
    frame: np.ndarray
    residual: np.ndarray
    slopes: np.ndarray
    by_roughness: np.ndarray
    by_coat: np.ndarray
    by_varied: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True)
class Within:
    """Training pixels by the vertex that they are nearest to.

    Attributes:
        samples: N of them. vertex: int [N], below ``count``. unit_mm: the scene's unit of length.
    """

    samples: Samples
    vertex: np.ndarray
    count: int
    unit_mm: float

    @classmethod
    def of(cls, samples: Samples, surface: Surface, unit_mm: float) -> Within:
        return cls(samples, samples.nearest(surface.triangles), len(surface.vertices_mm), unit_mm)

    def renewed(
        self, material: Tensor, shared: Globals, held: tuple[str, ...], noise: float, varied: Varied = STILL
    ) -> Renewed:
        """A Gauss–Newton step: light, response and what is ``varied`` by what is off the highlights, then f0
        and the coat by all.

        How diffuse light falls off towards grazing says most of γ, and the lobe that tissue really has is
        nobody's: off the highlights its shape, which Burley's roughness sets, is found beside them and left.
        Vignetting stays as the probe has found it by the same differences.

        Args:
            material: [N, 4] at the samples. held: which of n, q and gamma stay. noise: of a pixel, in display
                values.
        """
        found = self._dull_step(material, shared, held, noise, varied)
        if not shared.specular:
            return found
        shone = self.shone(material, found.shared, noise)
        return replace(found, shared=shone.shared, roughness=shone.roughness)

    def moved(
        self, material: Tensor, shared: Globals, held: tuple[str, ...], noise: float, varied: Varied
    ) -> Renewed:
        """A Gauss–Newton step of light, response and guides, which are among what is ``varied``, by what is
        off the highlights of some vertices. Arguments as in ``renewed``."""
        rows = self._of_some(torch.ones(len(self.samples), dtype=torch.bool), GUIDE_PIXELS)
        some = replace(self, samples=self.samples[rows], vertex=self.vertex[rows.numpy()])
        return some._dull_step(material[rows], shared, held, noise, varied)

    def shone(self, material: Tensor, shared: Globals, noise: float) -> Renewed:
        """A step of f0 and, where there is a coat, of it and of roughness, which pass for one another.

        Without a coat roughness is left to the materials: diffuse light depends on it as well, and it would
        take up what other faults of the model leave.
        """
        kept = ("level", "n", "q", "gamma", "k2", "contrast", "albedo scale")
        return self._step(material, shared, kept, torch.ones(len(self.samples), dtype=torch.bool), noise)

    def highlights(self, material: Tensor, shared: Globals, noise: float) -> Callable[[Coat], Highlights]:
        """Sightings near the mirror direction, by a coat over them. Clipped ones say 'at least' whatever its
        weight: they are what a coat explains first, and its absence has to answer for them, too.

        Args:
            material: [N, 4] at the samples. noise: of a pixel, in display values.
        """
        shiny = self._of_some(self.samples.sin2 < DIFFUSE_SIN2, HIGHLIGHT_PIXELS)

        def under(coat: Coat) -> Highlights:
            seen = self.sightings(material, replace(shared, coat=coat), shiny, noise, at_least=True)
            nuisance = np.c_[seen.slopes[:, F0], seen.by_roughness]
            return Highlights(seen.vertex, seen.residual, nuisance, seen.by_coat)

        return under

    def hues(self, material: Tensor, shared: Globals, noise: float) -> Callable[[Tone], Hues]:
        """Ratios of channels off the highlights, by the tone curve that is taken off the photos.

        Args:
            material: [N, 4] at the samples. noise: of a pixel, in display values.
        """
        diffuse = self._of_some(self.samples.sin2 > DIFFUSE_SIN2, HUE_PIXELS)
        rows = self._coloured(diffuse)
        model = linearise(self.samples[rows], material[rows], shared.under(None))
        bright = ((model.predicted > DARKEST) & (model.predicted < 1)).all(dim=1)
        rows, predicted = rows[bright], model.predicted[bright].double()
        shown = self.samples.color[rows].double().numpy() / 255
        by_raw = roughness_slope(material[rows, 3])[:, None]
        passing = [model.by_globals[bright][..., F0], model.by_roughness[bright] * by_raw]
        if shared.bounces:
            passing.append(model.by_globals[bright][..., -1])

        alike = np.full(len(rows), RATIO_ERROR**2)

        def without(tone: Tone) -> Hues:
            steep, found = predicted * tone.slope(predicted), []
            untoned = torch.log(torch.from_numpy(tone.undone(shown)) / predicted)
            relative = [untoned, *(x / predicted for x in passing), bend(predicted) / steep]
            for number, ratio in enumerate(torch.from_numpy(RATIOS)):
                variance = ((noise / steep) ** 2 @ ratio**2).numpy()
                columns = tuple((x @ ratio).numpy() for x in relative)
                place, _, *means, weight = self._means(rows, columns, variance, alike)
                found.append((place + number * self.count, means[0], np.stack(means[1:], axis=1), weight))
            return Hues(*map(np.concatenate, zip(*found, strict=True)))

        return without

    def _of_some(self, chosen: Tensor, pixels: int) -> Tensor:
        """Of the ``chosen`` samples (bool [N]) about so many, all of some vertices."""
        return chosen & torch.from_numpy(self.vertex % max(1, int(chosen.sum()) // pixels) == 0)

    def _dull_step(
        self, material: Tensor, shared: Globals, held: tuple[str, ...], noise: float, varied: Varied
    ) -> Renewed:
        """That of light, response and what is ``varied``, by what is off the highlights."""
        diffuse = self.samples.sin2 > DIFFUSE_SIN2
        return self._step(material, shared, (*held, "level", "f0", "k2", "contrast"), diffuse, noise, varied)

    def _coloured(self, chosen: Tensor) -> Tensor:
        """Rows [R] of the ``chosen`` samples (bool [N]) in which no channel is dark or clipped."""
        shown = self.samples.color
        return torch.nonzero(chosen & (shown.amin(dim=1) > DARK) & (shown.amax(dim=1) < BRIGHT))[:, 0]

    def _step(
        self,
        material: Tensor,
        shared: Globals,
        held: tuple[str, ...],
        chosen: Tensor,
        noise: float,
        varied: Varied = STILL,
    ) -> Renewed:
        free = free_directions(shared, held)
        seen = self.sightings(material, shared, chosen, noise, varied)
        if not free.shape[1] or len(seen.residual) < LEAST_SIGHTINGS:
            return Renewed(shared, np.zeros(varied.frames), np.zeros((varied.guides, 3)))
        diffuse = "f0" in held
        frame = np.searchsorted(self.samples.views.frames, seen.frame) if varied.frames else None
        coated = not diffuse and shared.coat is not None
        columns, prior = self._columns(seen, shared, free, varied, diffuse, coated)
        faint, ridge = varied.faint.coefficients, np.zeros(columns.shape[1])
        ends = np.cumsum([free.shape[1], 3 * varied.guides, len(faint)])
        ridge[slice(*ends[1:])] = FAINT_RIDGE
        target = seen.residual + columns[:, slice(*ends[1:])] @ faint
        design = Design(columns, seen.vertex, self.count, frame, seen.weight, prior, ridge)
        found = regress(target, design, varied.frames, rounds=REWEIGHTS)
        along, aside_mm, fainter, shine = np.split(found.coefficients, ends)
        along, (rougher, wetter) = free @ along, shine if coated else (0.0, 0.0)
        spread = np.r_[global_prior(self.unit_mm, shared)[1].numpy(), ROUGHNESS_LOGIT_SPREAD]
        length = min(1.0, float((spread / np.maximum(np.abs(np.r_[along, rougher]), 1e-12)).min()))
        if coated:
            weight = max(0.0, shared.coat.weight + length * float(wetter))
            shared = replace(shared, coat=replace(shared.coat, weight=weight))
        log_gain = found.intercepts / shared.gamma if varied.frames else np.zeros(0)
        moved = bounded(shared, shared.vector + torch.from_numpy(length * along))
        aside_mm, fainter = length * aside_mm.reshape(-1, 3), length * (fainter - faint)
        return Renewed(moved, length * log_gain, aside_mm, length * float(rougher), fainter)

    def _columns(
        self, seen: Sightings, shared: Globals, free: np.ndarray, varied: Varied, diffuse: bool, coated: bool
    ) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Columns of the ``free`` directions, of what is ``varied``, first of guides' places, of roughness
        where light is ``diffuse`` or a coat is sought, and then of its weight; and what is known of their
        coefficients."""
        mean, spread = (x.numpy() for x in global_prior(self.unit_mm, shared))
        known = np.zeros(seen.by_varied.shape[1])
        known[: 3 * varied.guides] = TEMPER / (ASIDE_SPREAD * self.samples.distance_mm) ** 2
        sure = TEMPER / spread**2
        parts = [free.T @ np.diag(sure) @ free, np.diag(known)]
        pulls = [free.T @ (sure * (mean - shared.vector.numpy())), 0 * known]
        columns = [seen.slopes @ free, seen.by_varied]
        if diffuse or coated:
            columns.append(seen.by_roughness[:, None])
            parts.append([[TEMPER / ROUGHNESS_LOGIT_SPREAD**2]])
            pulls.append([0.0])
        if coated:
            columns.append(seen.by_coat[:, None])
            parts.append([[TEMPER / COAT_SPREAD**2]])
            pulls.append([-TEMPER * shared.coat.weight / COAT_SPREAD**2])
        return np.hstack(columns), (scipy.linalg.block_diag(*parts), np.concatenate(pulls))

    def sightings(
        self,
        material: Tensor,
        shared: Globals,
        chosen: Tensor,
        noise: float,
        varied: Varied = STILL,
        at_least: bool = False,
    ) -> Sightings:
        """Sightings of the ``chosen`` samples (bool [N]) that are neither dark nor clipped; but under a coat
        that shines, or if asked for, a clipped channel says ``at_least``.

        What varies among the pixels of a sighting is where about the vertex they lie: texture, not light.
        """
        clipped = self.samples.color >= BRIGHT
        usable = chosen & (self.samples.color.amax(dim=1) > 0)
        if not at_least and (shared.coat is None or shared.coat.weight == 0):
            usable &= ~clipped.any(dim=1)
        rows = torch.nonzero(usable)[:, 0]
        model = linearise(self.samples[rows], material[rows], shared)
        tells = ~clipped[rows] | (model.predicted < 1)
        floor = math.exp(shared.gamma * math.log(shading.RADIANCE_MIN))
        predicted = torch.where(tells, model.predicted, 1.0).double().mean(dim=1)
        shown = self.samples.color[rows].double().mean(dim=1) / 255
        bright = (torch.minimum(shown, predicted) > DARKEST) & tells.any(dim=1)
        rows, tells, predicted = rows[bright], tells[bright].double(), (predicted[bright] + floor).numpy()
        residual = np.log(shown[bright].numpy() + floor) - np.log(predicted)
        slopes = (model.by_globals[bright] * tells[..., None]).mean(dim=1).numpy() / predicted[:, None]
        by_coat = np.zeros(len(predicted))
        if model.by_coat is not None:
            by_coat = (model.by_coat[bright] * tells).mean(dim=1).numpy() / predicted
        by_guides = self._by_guides(rows, material, shared, varied, tells) / predicted
        shapes = varied.faint.shapes(self.samples)[rows.numpy()].T
        by_faint = shared.gamma * slopes[:, LEVEL] * shapes
        by_raw = roughness_slope(material[rows, 3])[:, None]
        by_roughness = (model.by_roughness[bright] * by_raw * tells).mean(dim=1).numpy() / predicted
        columns = (residual, by_roughness, by_coat, *slopes.T, *by_guides, *by_faint)
        alike = MODEL_ERROR**2 / trust(self.samples.cos[rows].numpy())
        vertex, frame, *means, weight = self._means(rows, columns, (noise / predicted) ** 2, alike)
        by_shared, by_varied = np.split(np.stack(means[3:], axis=1), [slopes.shape[1]], axis=1)
        return Sightings(vertex, frame, means[0], by_shared, *means[1:3], by_varied, weight)

    def _means(
        self, rows: Tensor, columns: tuple[np.ndarray, ...], variance: np.ndarray, alike: np.ndarray
    ) -> list[np.ndarray]:
        """Vertex, frame, means of the ``columns`` and their inverse variance of what the samples ``rows`` [R]
        show of a vertex in one photo, each [S].

        Noise of ``variance`` [R] is each pixel's own; all have alike what the model errs by, of variance
        ``alike`` [R].
        """
        place = self.vertex[rows.numpy()].astype(np.int64) << 32 | self.samples.frame[rows].numpy()
        place, which = np.unique(place, return_inverse=True)
        total = np.bincount(which, 1 / variance, len(place))
        means = [np.bincount(which, column / variance, len(place)) / total for column in columns]
        weight = 1 / (1 / total + np.bincount(which, alike, len(place)) / np.bincount(which))
        return [place >> 32, (place & 0xFFFFFFFF).astype(np.int32), *means, weight]

    def _by_guides(
        self, rows: Tensor, material: Tensor, shared: Globals, varied: Varied, tells: Tensor
    ) -> np.ndarray:
        """Slopes [3K, R] of the mean display values of samples ``rows`` by the guides' places, 1/mm; of the
        channels of which the photo ``tells`` [R, 3]."""
        slopes = np.zeros((3 * varied.guides, len(rows)))
        if varied.guides:
            samples, material, step_mm = self.samples[rows], material[rows], ASIDE * self.samples.distance_mm
            for slope, (more, less) in zip(slopes, varied.aside(samples, step_mm), strict=True):
                change = predict(more, material, shared) - predict(less, material, shared)
                slope[:] = (change * tells).mean(dim=1).numpy() / (2 * step_mm)
        return slopes

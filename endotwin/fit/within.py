"""Light, response and f0 from what changes while one place of the tissue is looked at.

Each vertex has an albedo that nobody knows. In log C that is an intercept of its own, and subtracting the
vertex's mean takes it out exactly: what is left varies with distance, angle and frame only. Unlike a fit
beside smooth albedo features, no texture can pass for shading, whatever those features cannot follow.

The gain of a frame is an intercept, too. A camera that comes nearer turns its gain down, so that gains pass
for most of the fall-off: found in turns with it, they would stay where they were first guessed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
import torch
from torch import Tensor

from endotwin.effects.coat import Coat
from endotwin.evidence.coat import LEAST_SIGHTINGS, Highlights
from endotwin.fit.gauss_newton import TEMPER, bounded, free_directions, global_prior
from endotwin.fit.model import GLOBALS, Globals, linearise
from endotwin.light import shading
from endotwin.pixels.fixed_effects import Design, regress
from endotwin.pixels.samples import Samples
from endotwin.pixels.start import BRIGHT, DIFFUSE_SIN2
from endotwin.surface import Surface

DARKEST = 0.03
"""Display value of the prediction below which noise rules the logarithm."""

MODEL_ERROR = 0.02
"""Relative error of a prediction whose noise is 0: normals, albedo within a vertex's cell."""

COAT_SPREAD = 2.0
"""Standard deviation of a coat's weight about 0: tissue is wet, not lacquered."""

HIGHLIGHT_PIXELS = 30_000
"""Of the highlights, all of some vertices; more would not change the mind about a coat."""

F0 = GLOBALS.index("ln f0")
REWEIGHTS = 4


@dataclass(frozen=True)
class Sightings:
    """What the pixels of a vertex in one photo tell together, S of them.

    Attributes:
        vertex, frame: int [S]. residual: ln photo − ln prediction [S]. slopes: d ln C by the shared
            parameters [S, G]. by_coat: d ln C by the coat's weight [S], 0 without one. weight: inverse
            variance [S].
    """

    vertex: np.ndarray
    frame: np.ndarray
    residual: np.ndarray
    slopes: np.ndarray
    by_coat: np.ndarray
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
        self, material: Tensor, shared: Globals, held: tuple[str, ...], noise: float, frames: int = 0
    ) -> tuple[Globals, np.ndarray]:
        """``shared`` after a Gauss–Newton step: light and response by what is off the highlights, then f0 and
        the coat by all; and what the first adds to the logarithms of the ``frames``' gains, [frames].

        Args:
            material: [N, 4] at the samples. held: which of n, q and gamma stay. noise: of a pixel, in display
                values. frames: of the samples' views, if each has a gain of its own; 0: none has.
        """
        diffuse = self.samples.sin2 > DIFFUSE_SIN2
        shared, log_gain = self._step(material, shared, (*held, "level", "f0"), diffuse, noise, frames)
        if shared.specular:
            kept = ("level", "n", "q", "gamma")
            shared, _ = self._step(material, shared, kept, torch.ones_like(diffuse), noise)
        return shared, log_gain

    def highlights(self, material: Tensor, shared: Globals, noise: float) -> Callable[[Coat], Highlights]:
        """Sightings near the mirror direction, by a coat of weight 0 over them.

        Args:
            material: [N, 4] at the samples. noise: of a pixel, in display values.
        """
        shiny = self.samples.sin2 < DIFFUSE_SIN2
        shiny &= torch.from_numpy(self.vertex % max(1, int(shiny.sum()) // HIGHLIGHT_PIXELS) == 0)

        def under(coat: Coat) -> Highlights:
            seen = self.sightings(material, replace(shared, coat=coat), shiny, noise)
            return Highlights(seen.vertex, seen.residual, seen.slopes[:, F0], seen.by_coat)

        return under

    def _step(
        self,
        material: Tensor,
        shared: Globals,
        held: tuple[str, ...],
        chosen: Tensor,
        noise: float,
        frames: int = 0,
    ) -> tuple[Globals, np.ndarray]:
        coated = "f0" not in held and shared.coat is not None
        free = free_directions(shared, held)
        seen = self.sightings(material, shared, chosen, noise)
        if not free.shape[1] or len(seen.residual) < LEAST_SIGHTINGS:
            return shared, np.zeros(frames)
        mean, spread = (x.numpy() for x in global_prior(self.unit_mm, len(shared.vector)))
        precision = free.T @ np.diag(TEMPER / spread**2) @ free
        pull = free.T @ (TEMPER * (mean - shared.vector.numpy()) / spread**2)
        columns = seen.slopes @ free
        if coated:
            columns = np.c_[columns, seen.by_coat]
            precision = scipy.linalg.block_diag(precision, TEMPER / COAT_SPREAD**2)
            pull = np.r_[pull, -TEMPER * shared.coat.weight / COAT_SPREAD**2]
        frame = np.searchsorted(self.samples.views.frames, seen.frame) if frames else None
        design = Design(columns, seen.vertex, self.count, frame, seen.weight, (precision, pull))
        fitted = regress(seen.residual, design, frames, rounds=REWEIGHTS)
        found = fitted.coefficients
        along = free @ found[: free.shape[1]]
        length = min(1.0, float((spread / np.maximum(np.abs(along), 1e-12)).min()))
        if coated:
            weight = max(0.0, shared.coat.weight + length * float(found[-1]))
            shared = replace(shared, coat=replace(shared.coat, weight=weight))
        log_gain = length / shared.gamma * fitted.intercepts if frames else np.zeros(0)
        return bounded(shared, shared.vector + torch.from_numpy(length * along)), log_gain

    def sightings(self, material: Tensor, shared: Globals, chosen: Tensor, noise: float) -> Sightings:
        """Sightings of the ``chosen`` samples (bool [N]) that are neither dark nor clipped; but under a coat
        that shines a clipped channel says 'at least'.

        What varies among the pixels of a sighting is where about the vertex they lie: texture, not light.
        """
        clipped = self.samples.color >= BRIGHT
        usable = chosen & (self.samples.color.amax(dim=1) > 0)
        if shared.coat is None or shared.coat.weight == 0:
            usable &= ~clipped.any(dim=1)
        rows = torch.nonzero(usable)[:, 0]
        model = linearise(self.samples[rows], material[rows], shared)
        tells = ~clipped[rows] | (model.predicted < 1)
        floor = math.exp(shared.gamma * math.log(shading.RADIANCE_MIN))
        predicted = torch.where(tells, model.predicted, 1.0).double().mean(dim=1)
        bright = (predicted > DARKEST) & tells.any(dim=1)
        rows, tells, predicted = rows[bright], tells[bright].double(), (predicted[bright] + floor).numpy()
        shown = self.samples.color[rows].double().mean(dim=1).numpy()
        residual = np.log(shown / 255 + floor) - np.log(predicted)
        slopes = (model.by_globals[bright] * tells[..., None]).mean(dim=1).numpy() / predicted[:, None]
        by_coat = np.zeros(len(predicted))
        if model.by_coat is not None:
            by_coat = (model.by_coat[bright] * tells).mean(dim=1).numpy() / predicted
        weight = 1 / ((noise / predicted) ** 2 + MODEL_ERROR**2)
        place = self.vertex[rows.numpy()].astype(np.int64) << 32 | self.samples.frame[rows].numpy()
        place, which = np.unique(place, return_inverse=True)
        total = np.bincount(which, weight, len(place))
        averaged = (residual, by_coat, *slopes.T)
        means = [np.bincount(which, weight * column, len(place)) / total for column in averaged]
        frame = (place & 0xFFFFFFFF).astype(np.int32)
        return Sightings(place >> 32, frame, means[0], np.stack(means[2:], axis=1), means[1], total)

"""Bloom from photos: what highlights beyond the brightest level throw on their surroundings."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch

from endotwin.effects import Decision, unjudged
from endotwin.effects.bloom import SATURATION, Bloom
from endotwin.fit.beneath import decibels
from endotwin.fit.film import LEAST_DB, Found, Report
from endotwin.light import shading
from endotwin.pixels.samples import CLIPPED, Samples, Views
from endotwin.run.ahead import ahead
from endotwin.run.threads import THREADS
from endotwin.sequence.spread import spread
from endotwin.surface.silhouettes import dilated

PHOTOS = 4
"""Spread over a sequence: every other one chooses share and radius, the rest judge."""

RADII = 0.003 * 2.0 ** np.arange(5)
"""That are tried, in image heights."""

BESIDE_PX = 2
"""So near to what saturates its blurred edge is, and what a highlight's place errs by."""


def bloom(wet: Found, samples: Samples, wanted: str, report: Report) -> tuple[Bloom | None, Decision]:
    """The bloom that photos show about what saturates in a model with its film, ``wet``; and why.

    ``samples`` are the training pixels; ``wanted`` is auto or off.

    Its share is that of least squares in display values, to first order, for each radius; photos that did
    not choose it judge by how much it explains of what is not saturated.
    """
    if wanted == "off":
        return None, unjudged(wanted)
    views = samples.views
    if len(views.frames) < 2 or not (samples.color >= CLIPPED).any():
        return None, Decision("off", "no photos with saturated highlights")
    began, photos = time.perf_counter(), []
    rows = spread(len(views.frames), PHOTOS)
    for done, photo in enumerate(ahead(lambda row: _Glare.of(wet, views, row), rows, THREADS), 1):
        photos.append(photo)
        report("look for bloom", done, len(rows))
    choosing, judging = sum(photos[::2], _Glare.none()), sum(photos[1::2], _Glare.none())
    best = int(choosing.gains.argmax())
    gain_db = decibels(judging.squared, judging.left(choosing.shares)[best])
    found = gain_db >= LEAST_DB
    effect = Bloom(float((choosing + judging).shares[best]), float(RADII[best])) if found else None
    reason = f"glare of what saturates explains {gain_db:+.2f} dB of what other photos show beside it"
    seconds = round(time.perf_counter() - began, 3)
    return effect, Decision("on" if found else "off", reason, round(gain_db, 3), seconds)


@dataclass(frozen=True)
class _Glare:
    """Sums over pixels of photos that are not saturated.

    Attributes:
        squared: of the error e of the model without bloom, in display values. pull, pushed: of h·e and h²,
            [K], where bloom of share 1 and each of RADII adds h.
    """

    squared: float
    pull: np.ndarray
    pushed: np.ndarray

    @classmethod
    def none(cls) -> _Glare:
        return cls(0.0, np.zeros(len(RADII)), np.zeros(len(RADII)))

    def __add__(self, other: _Glare) -> _Glare:
        return _Glare(self.squared + other.squared, self.pull + other.pull, self.pushed + other.pushed)

    @property
    def shares(self) -> np.ndarray:
        """Of least squares, [K]."""
        return np.clip(self.pull / np.maximum(self.pushed, 1e-12), 0, 1)

    @property
    def gains(self) -> np.ndarray:
        """By how much those lower the squared error, [K]."""
        return self.squared - self.left(self.shares)

    def left(self, shares: np.ndarray) -> np.ndarray:
        """Squared error with bloom of ``shares`` [K]."""
        return self.squared - 2 * shares * self.pull + shares**2 * self.pushed

    @classmethod
    def of(cls, wet: Found, views: Views, row: int) -> _Glare:
        """Of the photo of ``row`` among the ``views``."""
        model = wet.model
        based, gamma = model.photo(views, row), model.state.shared.gamma
        samples, seen = based.samples, based.radiance
        if wet.film is not None:
            seen = seen + model.shining(samples, row, wet.film, wet.effect.roughness)
        shape, pixel = views.lens_mask.shape, samples.pixel.numpy()
        beyond = np.zeros((*shape, 3), np.float32)
        beyond.reshape(-1, 3)[pixel] = (seen - SATURATION).clamp(min=0)
        saturated = (beyond > 0).any(axis=2)
        saturated.flat[pixel] |= (samples.color >= CLIPPED).any(dim=1).numpy()
        told = ~dilated(saturated, BESIDE_PX).flat[pixel]
        pixel, seen = pixel[told], seen[told]
        error = (based.shown[told] - shading.respond(seen, gamma)).double().numpy()
        slope = (gamma * (seen + shading.RADIANCE_MIN) ** (gamma - 1)).double().numpy()
        pull, pushed = np.zeros(len(RADII)), np.zeros(len(RADII))
        if saturated.any():
            image = torch.from_numpy(beyond) + SATURATION
            for k, radius in enumerate(RADII):
                glare = Bloom(1.0, float(radius)).through(image, None, views.camera) - SATURATION
                added = slope * glare.reshape(-1, 3)[pixel].numpy()
                pull[k], pushed[k] = (added * error).sum(), (added**2).sum()
        return cls(float((error**2).sum()), pull, pushed)

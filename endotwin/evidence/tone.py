"""Whether a tone curve lies over the photos: what the hue of a place says as its brightness changes.

White light makes a place brighter or darker and leaves the ratios of its channels; so does any power of the
three. A curve that is no power does not. Whatever else the model of the light errs by, where it falls, how
fast, and how strong a photo's gain is, changes all channels alike, and cannot pass for one.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from endotwin.effects import Decision
from endotwin.effects.tone import Tone
from endotwin.evidence.probe import MIN_SIGMAS, Verdict, compared
from endotwin.pixels.fixed_effects import Design, regress

LEAST_SIGHTINGS = 16
ROUNDS = 4

LEAST_CONTRAST = 0.1
"""Less is none: bounced light that is not quite known turns hues with brightness, too, up to half so far."""


@dataclass(frozen=True)
class Hues:
    """Ratios of channels of a vertex in one photo, S of them, with a tone curve taken off the photos.

    Attributes:
        place: int [S], the vertex, another for each of the ratios. residual: ln of the photo's ratio less
            that of the prediction's [S]. slopes: what ln f0, the logit of roughness and contrast beyond the
            curve's would add to it [S, 3]. weight: inverse variance [S].
    """

    place: np.ndarray
    residual: np.ndarray
    slopes: np.ndarray
    weight: np.ndarray

    def design(self, curve: bool = True) -> Design:
        """f0, roughness and, with a ``curve``, contrast, beside an intercept a place."""
        columns = self.slopes if curve else self.slopes[:, :2]
        place = np.unique(self.place, return_inverse=True)[1].reshape(-1)
        return Design(columns, place, int(place.max()) + 1, weight=self.weight)


def judged(without: Callable[[Tone], Hues], wanted: str) -> tuple[Tone | None, Decision]:
    """The tone curve that the hues call for, or that is ``wanted`` (auto, on or off); and why.

    Args:
        without: the hues, by the curve that is taken off.
    """
    if wanted == "off":
        return None, Decision("off", "forced off")
    began = time.perf_counter()
    tone, verdict = steadied(Tone(), without), _verdict(without(Tone()))
    took_s = round(time.perf_counter() - began, 3)
    gain_db = round(verdict.gain_db, 3)
    contrast = f"a contrast of {tone.contrast:.2f} predicts held-out hues better by {verdict}"
    if wanted == "auto" and (abs(tone.contrast) < LEAST_CONTRAST or verdict.sigmas < MIN_SIGMAS):
        return None, Decision("off", f"none that counts: {contrast}", gain_db, took_s)
    forced = "forced on; " if wanted == "on" else ""
    return tone, Decision("on", forced + contrast, gain_db, took_s)


def steadied(tone: Tone, without: Callable[[Tone], Hues]) -> Tone:
    """The curve without which the hue of each place is steadiest, sought from ``tone``."""
    (contrast,) = Tone.parameters()
    for _ in range(ROUNDS):
        hues = without(tone)
        if len(hues.residual) < LEAST_SIGHTINGS:
            return tone
        more = float(regress(hues.residual, hues.design()).coefficients[-1])
        tone = Tone(float(np.clip(tone.contrast + more, contrast.low, contrast.high)))
    return tone


def _verdict(hues: Hues) -> Verdict:
    """How much better a curve predicts hues of places that did not choose it, to first order."""
    if len(hues.residual) < LEAST_SIGHTINGS:
        return Verdict(0.0, 0.0)
    plain, bent = hues.design(curve=False), hues.design()
    half = (np.random.default_rng(0).random(plain.count) < 0.5)[plain.group]
    return compared(hues.residual, plain, bent, half, regress(hues.residual, plain).width)

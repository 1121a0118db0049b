"""Whether a tone curve lies over the photos: what the hue of a place says as its brightness changes.

White light makes a place brighter or darker and leaves the ratios of its channels; so does any power of the
three. A curve that is no power does not. Whatever else the model of the light errs by, where it falls, how
fast, and how strong a photo's gain is, changes all channels alike, and cannot pass for one. What throws red
light into the dark, as tissue does, makes hues steadier with a contrast below 0: no processor has that.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from endotwin.effects import Decision
from endotwin.effects.tone import Tone
from endotwin.evidence.coat import LEAST_SIGHTINGS
from endotwin.evidence.verdict import MIN_SIGMAS, Verdict, predicts_better
from endotwin.pixels.fixed_effects import Design, regress

RATIOS = np.array([[1.0, -1.0, 0.0], [0.5, 0.5, -1.0]])
"""Red to green, and both to blue, of the channels' logarithms."""

RATIO_ERROR = 0.004
"""Relative error of a prediction of such a ratio: what a normal or a distance errs by is alike in all
channels."""

ROUNDS, SETTLED = 4, 0.002
"""At most so many, and none after one that moves the contrast by less: a twentieth of a level of 255."""

TISSUE = 2
"""Slopes by what whitens: f0 and roughness."""

LEAST_CONTRAST = 0.1
"""Less is none: it changes values by 2.5 of 255 levels at most, and beside bounced light hues are known no
better."""

(CONTRAST,) = Tone.parameters()
"""Its range: the search for a curve ends at its edges."""

HINT = LEAST_CONTRAST / 2
"""What hues have to ask for where light bounces, for all pixels to say whether there is a curve."""


@dataclass(frozen=True)
class Hues:
    """Ratios of channels of a vertex in one photo, S of them, with a tone curve taken off the photos.

    Attributes:
        place: int [S], the vertex, another for each of the ratios. residual: ln of the photo's ratio less
            that of the prediction's [S]. slopes: what would be added to it by ln f0, by the logit of
            roughness, where light bounces by the logarithm of its strength, and by contrast, [S, 3 or 4].
        weight: inverse variance [S].
    """

    place: np.ndarray
    residual: np.ndarray
    slopes: np.ndarray
    weight: np.ndarray

    def design(self, passing: int = TISSUE, curve: bool = True) -> Design:
        """What may pass for a curve, as many of the first slopes, and, with a ``curve``, contrast; beside an
        intercept a place."""
        columns = [*range(passing), *([-1] if curve else [])]
        place = np.unique(self.place, return_inverse=True)[1].reshape(-1)
        return Design(self.slopes[:, columns], place, int(place.max()) + 1, weight=self.weight)


def judged(without: Callable[[Tone], Hues], wanted: str) -> tuple[Tone | None, Decision]:
    """The tone curve that the hues call for, or that is ``wanted`` (auto or on); and why.

    Where light bounces they have to call for one beside a bounce of any strength, too: what the bounce
    lacks turns hues as well, most of all where its strength is found too far off. Beside the bounce that was
    found without a curve, and has made up for one, they ask for too little; beside any, for too much: a fit
    of all may begin halfway, and says whether there is one where they give a HINT. Hues that no curve
    steadies, however strong, are turned by something else: by bounced light, if that was left out.

    Args:
        without: the hues, by the curve that is taken off.
    """
    began = time.perf_counter()
    trials = _trials(without)
    tone, verdict = Tone(sum(curve.contrast for curve, _ in trials) / len(trials)), trials[0][1]
    told = " and, beside a bounce of any strength, ".join(
        f"a contrast of {curve.contrast:.2f} predicts held-out hues better by {each}"
        for curve, each in trials
    )
    least = min(tone.contrast, trials[-1][0].contrast)
    enough = LEAST_CONTRAST if len(trials) == 1 else HINT
    sure = all(each.sigmas >= MIN_SIGMAS for _, each in trials) and least >= enough
    gain_db, took_s = round(verdict.gain_db, 3), round(time.perf_counter() - began, 3)
    if wanted == "auto" and len(trials) == 1 and tone.contrast >= CONTRAST.high:
        return None, Decision("off", f"none: hues ask for more than any curve has ({told})", gain_db, took_s)
    if wanted == "auto" and not sure:
        return None, Decision("off", f"none that counts: {told}", gain_db, took_s)
    forced = "forced on; " if wanted == "on" else ""
    return tone, Decision("on", forced + told, gain_db, took_s)


def _trials(without: Callable[[Tone], Hues]) -> list[tuple[Tone, Verdict]]:
    """The curve and what it is worth; then, where light bounces, the same beside a bounce of any strength."""
    plain = without(Tone())
    passing = range(TISSUE, plain.slopes.shape[1])
    return [(steadied(Tone(), without, each), _verdict(plain, each)) for each in passing]


def steadied(tone: Tone, without: Callable[[Tone], Hues], passing: int = TISSUE) -> Tone:
    """The curve without which the hue of each place is steadiest, sought from ``tone``."""
    for _ in range(ROUNDS):
        hues = without(tone)
        if len(hues.residual) < LEAST_SIGHTINGS:
            return tone
        more = float(regress(hues.residual, hues.design(passing)).coefficients[-1])
        before, tone = tone, Tone(float(np.clip(tone.contrast + more, CONTRAST.low, CONTRAST.high)))
        if abs(tone.contrast - before.contrast) < SETTLED:
            break
    return tone


def _verdict(hues: Hues, passing: int) -> Verdict:
    """How much better a curve predicts hues of places that did not choose it, to first order."""
    if len(hues.residual) < LEAST_SIGHTINGS:
        return Verdict(0.0, 0.0)
    plain, bent = hues.design(passing, curve=False), hues.design(passing)
    half = (np.random.default_rng(0).random(plain.count) < 0.5)[plain.group]
    return predicts_better(hues.residual, plain, bent, half)

"""Whether the tissue wears a wet coat: what its highlights show beside the lobe of the tissue itself."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.stats import chi2

from endotwin.effects import Decision
from endotwin.effects.coat import Coat
from endotwin.evidence.probe import Verdict, compared
from endotwin.pixels.fixed_effects import Design, regress, robust_losses

ROUGHNESSES = (0.045, 0.06, 0.09, 0.13, 0.19, 0.27)
TAILS = (2.0, 1.0)
LEAST_SIGHTINGS = 16

SEARCH_ROUNDS = 2
"""Of the regression by which roughnesses are ranked."""

WORTH = chi2.isf(0.01 / (len(ROUGHNESSES) * len(TAILS)), df=1) / 2
"""Log likelihood by which the best of as many lobes beats none in one of a hundred bare tissues."""


@dataclass(frozen=True)
class Highlights:
    """Sightings of vertices near the mirror direction, S of them, beside a prediction without a coat.

    Attributes:
        vertex: int [S]. residual: ln photo − ln prediction [S]. by_tissue: d ln C by ln f0 and by the
            logit of roughness [S, 2]. by_coat: and by the weight of a coat [S].
    """

    vertex: np.ndarray
    residual: np.ndarray
    by_tissue: np.ndarray
    by_coat: np.ndarray

    @cached_property
    def design(self) -> Design:
        """f0, roughness and coat, beside an intercept a vertex."""
        vertex = np.unique(self.vertex, return_inverse=True)[1].reshape(-1)
        return Design(np.c_[self.by_tissue, self.by_coat], vertex, int(vertex.max()) + 1)


def judged(under: Callable[[Coat], Highlights], wanted: str) -> tuple[Coat | None, Decision]:
    """The coat that the highlights call for, or that is ``wanted`` (auto, on or off); and why.

    Args:
        under: the highlights, by the coat whose weight is sought.
    """
    if wanted == "off":
        return None, Decision("off", "forced off")
    began = time.perf_counter()
    coat, verdict = best_coat(under)
    took_s = round(time.perf_counter() - began, 3)
    forced = "forced on; " if wanted == "on" else ""
    if wanted == "auto" and not verdict.keep:
        reason = f"does not predict held-out highlights better ({verdict})"
        return None, Decision("off", reason, round(verdict.gain_db, 3), took_s)
    reason = f"{forced}predicts held-out highlights better by {verdict}"
    return coat, Decision("on", reason, round(verdict.gain_db, 3), took_s)


def best_coat(under: Callable[[Coat], Highlights]) -> tuple[Coat, Verdict]:
    """The coat that predicts highlights best, and by how much better than none it does on vertices that did
    not choose its weight.

    Lobes are ranked by what they leave after a second step: a coat may outshine what is under it, where the
    logarithm is far from linear in its weight, and only one that shines can be held against clipped photos.
    One that hardly any sighting could have seen weighs nothing.
    """
    width, least, best = 0.0, np.inf, None
    for lobe in (Coat(0.0, roughness, tail) for tail in TAILS for roughness in ROUGHNESSES):
        seen = under(lobe)
        if len(seen.residual) < LEAST_SIGHTINGS:
            break
        width = width or regress(seen.residual, _bare(seen.design)).width
        bare, first = (_fitted(seen.residual, design, width) for design in (_bare(seen.design), seen.design))
        if first.weight <= 0 or first.loss > bare.loss - WORTH * width**2:
            continue
        near = under(replace(lobe, weight=first.weight))
        second = _fitted(near.residual, near.design, width)
        if second.loss < least:
            least, best = second.loss, (replace(lobe, weight=first.weight + second.weight), seen)
    if best is None:
        return Coat(0.0), Verdict(0.0, 0.0)
    coat, seen = best
    half = (np.random.default_rng(0).random(seen.design.count) < 0.5)[seen.design.group]
    verdict = compared(seen.residual, _bare(seen.design), seen.design, half, width)
    return replace(coat, weight=max(0.0, coat.weight)), verdict


@dataclass(frozen=True)
class _Fitted:
    """The coat's weight, and the sum of the losses beside it."""

    weight: float
    loss: float


def _fitted(residual: np.ndarray, design: Design, width: float) -> _Fitted:
    found = regress(residual, design, rounds=SEARCH_ROUNDS)
    return _Fitted(float(found.coefficients[-1]), float(robust_losses(residual, design, found, width).sum()))


def _bare(design: Design) -> Design:
    """``design`` without its coat."""
    return replace(design, columns=design.columns[:, :-1])

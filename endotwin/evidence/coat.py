"""Whether the tissue wears a wet coat: what its highlights show beside the lobe of the tissue itself."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from operator import attrgetter

import numpy as np
from scipy.special import chdtri

from endotwin.effects import Decision
from endotwin.effects.coat import Coat
from endotwin.evidence.verdict import Halved, Verdict, verdict_of
from endotwin.pixels.fixed_effects import Design, regress, robust_losses

ROUGHNESSES = (0.045, 0.06, 0.09, 0.13, 0.19, 0.27)
FINER = (1 / 1.2, 1.2)
"""Beside the best of each tail, none sharper than the sharpest."""

TAILS = (2.0, 1.0)
LEAST_SIGHTINGS = 16

SEARCH_ROUNDS = 2
"""Of the regression by which roughnesses are ranked."""

LONGEST_LOG = 1.5
"""The farthest that ln of a weight may rise in the step after the first."""

WORTH = chdtri(1, 0.01 / (len(ROUGHNESSES) * len(TAILS))) / 2
"""Log likelihood by which the best of as many lobes beats none in one of a hundred bare tissues."""


@dataclass(frozen=True)
class Highlights:
    """Sightings of vertices near the mirror direction, S of them, beside a prediction under some coat.

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


def judged(
    under: Callable[[Coat], Highlights], wanted: str, tried: bool = False
) -> tuple[Coat | None, Decision]:
    """The coat that the highlights call for, or that is ``wanted`` (auto or on); and why.

    Args:
        under: the highlights, by the coat whose weight is sought. tried: a hint is enough, since all pixels
            are asked before it is kept.
    """
    began = time.perf_counter()
    search = _Search(under, under(Coat(0.0)))
    found = search.best()
    coat = Coat(0.0) if found is None else found.coat
    verdict = Verdict(0.0, 0.0) if found is None else search.verdict(found)
    took_s = round(time.perf_counter() - began, 3)
    forced = "forced on; " if wanted == "on" else ""
    enough = verdict.hints if tried else verdict.keep
    if wanted == "auto" and not enough:
        reason = f"does not predict held-out highlights better ({verdict})"
        return None, Decision("off", reason, round(verdict.gain_db, 3), took_s)
    reason = f"{forced}predicts held-out highlights better by {verdict}"
    return coat, Decision("on", reason, round(verdict.gain_db, 3), took_s)


def best_coat(under: Callable[[Coat], Highlights]) -> Coat | None:
    """The coat that predicts highlights best; None where no coat is worth one."""
    found = _Search(under, under(Coat(0.0))).best()
    return None if found is None else found.coat


@dataclass(frozen=True)
class _Found:
    """A coat, the sum of the losses under it, and the highlights beside nearly this one."""

    coat: Coat
    loss: float
    near: Highlights


_LOSS = attrgetter("loss")


@dataclass(frozen=True)
class _Search:
    """Coats held against none.

    Lobes are ranked, and judged, where their weight is nearly found: a coat may outshine what is under it,
    where the logarithm is far from linear in its weight. One that hardly any sighting could have seen weighs
    nothing.

    Attributes:
        under: the highlights, by the coat whose weight is sought. dull: those beside none.
    """

    under: Callable[[Coat], Highlights]
    dull: Highlights

    @cached_property
    def _width(self) -> float:
        return regress(self.dull.residual, _bare(self.dull.design)).width

    @cached_property
    def _worth(self) -> float:
        """The most that a coat may leave."""
        bare = _fitted(self.dull.residual, _bare(self.dull.design), self._width)
        return bare.loss - WORTH * self._width**2

    def best(self) -> _Found | None:
        """The coat that predicts highlights best, if any is worth one."""
        if len(self.dull.residual) < LEAST_SIGHTINGS:
            return None
        every = [self._under_lobe(roughness, tail) for tail in TAILS for roughness in ROUGHNESSES]
        found = [each for each in every if each is not None]
        for tail in TAILS:
            if of_tail := [each for each in found if each.coat.tail == tail]:
                beside = (min(of_tail, key=_LOSS).coat.roughness * step for step in FINER)
                finer = (self._under_lobe(each, tail) for each in beside if each >= ROUGHNESSES[0])
                found += [each for each in finer if each is not None]
        return min(found, key=_LOSS, default=None)

    def _under_lobe(self, roughness: float, tail: float) -> _Found | None:
        """The weight of a lobe, where it is worth one."""
        lobe = Coat(0.0, roughness, tail)
        _, found = self._beside(lobe)
        if found.weight <= 0 or found.loss > self._worth:
            return None
        lobe = replace(lobe, weight=found.weight)
        _, found = self._beside(lobe)
        risen = min(found.weight / lobe.weight, LONGEST_LOG)
        lobe = replace(lobe, weight=lobe.weight * math.exp(risen))
        near, found = self._beside(lobe)
        return _Found(replace(lobe, weight=max(0.0, lobe.weight + found.weight)), found.loss, near)

    def _beside(self, coat: Coat) -> tuple[Highlights, _Fitted]:
        """The highlights under a coat, and what they say should be added to its weight."""
        seen = self.under(coat)
        return seen, _fitted(seen.residual, seen.design, self._width)

    def verdict(self, found: _Found) -> Verdict:
        """How much better the coat explains vertices that did not choose its weight."""
        both = (self.dull, _bare(self.dull.design)), (found.near, found.near.design)
        half = np.random.default_rng(0).random(1 + max(seen.vertex.max() for seen, _ in both)) < 0.5
        before, after = (
            np.bincount(
                seen.vertex,
                Halved.of(seen.residual, design, half[seen.vertex]).losses(self._width),
                len(half),
            )
            for seen, design in both
        )
        return verdict_of(before - after, float(after.sum()))


@dataclass(frozen=True)
class _Fitted:
    """What to add to the coat's weight, and the sum of the losses after it."""

    weight: float
    loss: float


def _fitted(residual: np.ndarray, design: Design, width: float) -> _Fitted:
    found = regress(residual, design, rounds=SEARCH_ROUNDS)
    return _Fitted(float(found.coefficients[-1]), float(robust_losses(residual, design, found, width).sum()))


def _bare(design: Design) -> Design:
    """``design`` without its coat."""
    return replace(design, columns=design.columns[:, :-1])

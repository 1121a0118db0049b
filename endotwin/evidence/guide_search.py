"""Where the light guides stand: the positions about the lens that predict held-out pixels best."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, cached_property, lru_cache
from itertools import chain

import numpy as np
from scipy.optimize import least_squares

from endotwin.evidence.glints import MOST_GUIDES, Glints
from endotwin.evidence.light_map import LightMap, places_mm
from endotwin.evidence.probe import Fitted, Hypothesis, Probe
from endotwin.evidence.verdict import MIN_SIGMAS, Verdict
from endotwin.evidence.worth import DOUBT, LEAST, hints_at_guides, worth, worth_another
from endotwin.light.guides import AT_LENS
from endotwin.pixels.fixed_effects import Design, Left

Guides = tuple[tuple[float, float, float], ...]
"""Positions in the camera frame, mm."""

RADIUS = 0.12
"""By what guides' places are measured, as a share of the median viewing distance: 2.4 mm at a tip that sees
the wall from 20 mm."""

SEARCH_PIXELS = 8_000
"""Guides are sought with so many pixels of the probe; those that are kept are polished with all."""

STEPS, TOLERANCE = 12, 1e-3
"""The search ends when positions move by less than this share of the radius, or the loss by less."""

DEEPEST = 1.0
"""Of the radius: guides lie at most so far behind the lens."""

ASIDE = 0.1
"""Of the radius: by so much guides are moved to find what their positions change. With less, the
shadows that jump from pixel to pixel hide it."""


class Ground:
    """What guides are sought on: pixels of a probe and its glints, and which pixels places about the lens
    see.

    Args:
        rows: which pixels of the probe that is meant by hypotheses about it these are; all, unless given.
    """

    def __init__(self, probe: Probe, glints: Glints, rows: np.ndarray | None = None):
        self.probe, self.glints, self._rows = probe, glints, rows
        self.radius_mm = RADIUS * probe.samples.distance_mm
        self.places_mm = places_mm(self.radius_mm)
        self.unshadowed = lru_cache(1)(self._unshadowed)

    @cached_property
    def part(self) -> Ground:
        """The same with some of the pixels."""
        probe, rows = self.probe.part(SEARCH_PIXELS)
        return Ground(probe, self.glints, rows)

    @cached_property
    def lit(self) -> np.ndarray:
        """Bool [N, K]: which of the places see each pixel's point."""
        return self.probe.visible(self.places_mm)

    @cached_property
    def _at_risk(self) -> np.ndarray:
        return np.flatnonzero(~self.lit.all(axis=1))

    def visible(self, guides_mm: np.ndarray) -> np.ndarray:
        """Bool [N, K]: which of guides [K, 3] see each pixel's point; those that all places see, all do."""
        visible = np.ones((len(guides_mm), len(self.probe)), bool).T
        visible[self._at_risk] = self.probe.visible(guides_mm, self._at_risk)
        return visible

    def borne_out(self, model: Fitted, verdict: Verdict) -> bool:
        """Whether guides of ``model`` gain what is worth their place by their ``verdict``, or something, and
        cast shadows that show: no light that is a little wrong throws those."""
        if worth("offset", verdict, model):
            return True
        return verdict.worth(LEAST) and self.unshadowed(model)[1].sigmas >= MIN_SIGMAS

    def in_doubt(self, model: Fitted, verdict: Verdict) -> bool:
        """Whether guides of ``model`` may be worth their place near where they are: they gain by their
        ``verdict``, and so do their shadows alone."""
        return verdict.worth(DOUBT) and self.unshadowed(model)[1].sigmas >= DOUBT.sigmas

    def _unshadowed(self, model: Fitted) -> tuple[Fitted, Verdict]:
        """``model`` with guides that cast no shadows, and what shadows say of those of the ``model``."""
        unshadowed = self.probe.fit(replace(model.hypothesis, shadows=False))
        return unshadowed, self.probe.told_by_shadows(model, unshadowed)

    def certain(self, model: Fitted, verdict: Verdict) -> bool:
        """Whether glints plainly stand about the guides of ``model``, and the pixels' ``verdict`` on it does
        not plainly contradict them."""
        return not verdict.contradicts and self.glints.tell(model.hypothesis.guides_mm)

    def of(self, hypothesis: Hypothesis) -> Hypothesis:
        """The hypothesis about these pixels."""
        if self._rows is None or hypothesis.bounced is None:
            return hypothesis
        return replace(hypothesis, bounced=hypothesis.bounced[self._rows])


def found_guides(ground: Ground, base: Hypothesis, forced: bool, near_mm: Guides = AT_LENS) -> Guides:
    """Positions of one to three guides that predict held-out pixels better than ``base``, camera frame; the
    lens where none do, and glints tell of none. They are sought where they explain the glints as well, and
    first ``near_mm``.

    One guide, and a glance at two and three, tell whether a search is worth its time. Two in the plane of the
    lens pass for one behind it: another is believed only beside those before it where they are best. With
    ``forced`` there is always a position: that of the most guides, if none is worth it.
    """
    probe = ground.probe
    plain, best, first = probe.fit(base), None, 1

    def under(guides_mm: Guides) -> Fitted:
        return probe.fit(replace(base, guides_mm=guides_mm, shadows=True))

    if near_mm != AT_LENS:
        near = replace(base, guides_mm=near_mm, shadows=True)
        near = under(Search(ground.part, near).settled())
        if ground.borne_out(near, probe.compare(plain, near)):
            return near.hypothesis.guides_mm
    search, told = Search(ground.part, base), ground.glints.told()
    if not (forced or told or search.hints()):
        return AT_LENS
    if told:
        found = under(search.best(told))
        if ground.certain(found, probe.compare(plain, found)):
            best, first = found, told + 1
    for number in range(first, MOST_GUIDES + 1):
        found = under(search.best(number))
        judge = _judged if best is None else _judged_another
        better, found = judge(ground, best or plain, found)
        if better or (forced and best is None and number == MOST_GUIDES):
            best = found
    return AT_LENS if best is None else Search(ground.part, best.hypothesis).settled()


def _judged(ground: Ground, plain: Fitted, found: Fitted) -> tuple[bool, Fitted]:
    """Whether the guides of ``found`` are worth their place beside the ``plain`` light at the lens; and they,
    where all pixels say that they are if that is in doubt."""
    verdict = ground.probe.compare(plain, found)
    if ground.borne_out(found, verdict):
        return True, found
    if not ground.in_doubt(found, verdict):
        return False, found
    found = polished(ground, found)
    return ground.borne_out(found, ground.probe.compare(plain, found)), found


def _judged_another(ground: Ground, best: Fitted, found: Fitted) -> tuple[bool, Fitted]:
    """Whether the guides of ``found`` are worth it beside the ``best`` of one less; and they, where all
    pixels say that they are if that is in doubt."""
    verdict = ground.probe.compare(best, found)
    if worth_another(verdict, found):
        return worth_another(ground.probe.compare(settled(ground, best), found), found), found
    if not verdict.hints:
        return False, found
    found = polished(ground, found)
    return worth_another(ground.probe.compare(polished(ground, best), found), found), found


def settled(ground: Ground, model: Fitted) -> Fitted:
    """``model`` with its guides where they predict best beside all its effects, if that is elsewhere."""
    return _moved(ground.probe, model, Search(ground.part, model.hypothesis).settled())


def polished(ground: Ground, model: Fitted) -> Fitted:
    """``model`` with its guides where all of the probe's pixels say that they are, if that is elsewhere."""
    return _moved(ground.probe, model, Search(ground, model.hypothesis).polished())


def _moved(probe: Probe, model: Fitted, guides_mm: Guides) -> Fitted:
    """``model`` with guides at ``guides_mm`` where held-out pixels say that it is better so."""
    moved = probe.fit(replace(model.hypothesis, guides_mm=guides_mm))
    return probe.better(model, moved)


class Search:
    """Guide positions that predict the pixels of a ``ground`` best beside the other effects of ``base``,
    shadows included, and where its glints lie."""

    def __init__(self, ground: Ground, base: Hypothesis):
        self._ground, self._probe = ground, ground.probe
        self._base = self._probe.fit(ground.of(base))
        self.best, self._from = cache(self._best), cache(self._refined)

    @cached_property
    def _map(self) -> LightMap:
        return LightMap.of(self._probe, self._base, self._ground.places_mm, self._ground.lit)

    def hints(self) -> bool:
        """Whether one guide, wherever it is best, or two or three near where light gathers predict better, or
        a little, and so do their shadows."""
        starts = (min(self._starts(number), key=self._loss) for number in range(2, MOST_GUIDES + 1))
        return any(map(self._hint, chain((self.best(1),), map(self._from, starts))))

    def _hint(self, guides_mm: Guides) -> bool:
        model = self._probe.fit(self._with(guides_mm))
        verdict = self._probe.compare(self._base, model)
        return hints_at_guides(verdict, model) or self._ground.in_doubt(model, verdict)

    def _best(self, number: int) -> Guides:
        """The best positions of so many guides."""
        return min(map(self._from, self._starts(number)), key=self._loss)

    def _starts(self, number: int) -> list[Guides]:
        """Where so many guides are sought from: where light gathers, and where the glints say."""
        told = self._ground.glints.guides_mm(number)
        return [_plain(start) for start in (*self._map.guides_mm(number), told) if len(start)]

    def settled(self) -> Guides:
        """The base's own guides, moved to where they predict best beside its effects."""
        return self._refined(self._base.hypothesis.guides_mm, axes=3)

    def polished(self) -> Guides:
        """As ``settled``, for guides that were sought in the plane of the lens."""
        return self._refined(self._refined(self._base.hypothesis.guides_mm), axes=3)

    def _refined(self, start_mm: Guides, axes: int = 2) -> Guides:
        """Guides moved from ``start_mm`` [K, 3] by Gauss–Newton, in the plane of the lens, or along 3
        axes."""

        @lru_cache(1)
        def left(x: bytes) -> Left:
            return self._left(self._guides(np.frombuffer(x), axes))

        def residuals(x: np.ndarray) -> np.ndarray:
            return np.r_[left(x.tobytes()).residuals, self._glints(self._guides(x, axes))]

        def slopes(x: np.ndarray) -> np.ndarray:
            steps = ASIDE * np.eye(len(x))
            aside = np.stack([self._guides(x + step, axes) for step in np.r_[steps, -steps]])
            pixels = left(x.tobytes()).beside(self._columns(aside))
            glints = np.stack([self._glints(each) for each in aside], axis=1)
            more, less = np.split(np.concatenate([pixels, glints]), 2, axis=1)
            return (more - less) / (2 * ASIDE)

        first = self._coordinates(start_mm, axes)
        found = least_squares(residuals, first, slopes, xtol=TOLERANCE, ftol=TOLERANCE, max_nfev=STEPS)
        return _plain(self._guides(found.x, axes))

    def _coordinates(self, guides_mm: Guides, axes: int) -> np.ndarray:
        """The first so many coordinates of K guides in radii, [K · axes]."""
        return np.asarray(guides_mm, np.float64)[:, :axes].ravel() / self._ground.radius_mm

    def _guides(self, x: np.ndarray, axes: int) -> np.ndarray:
        """Guides float32 [K, 3] of those coordinates; none lies before the lens, or DEEPEST behind it."""
        x = x.reshape(-1, axes)
        guides = np.pad(x, ((0, 0), (0, 3 - axes))).astype(np.float32)
        guides[:, 2] = np.clip(guides[:, 2], -DEEPEST, 0)
        return guides * np.float32(self._ground.radius_mm)

    def _loss(self, guides_mm: Guides) -> float:
        guides_mm = np.asarray(guides_mm, np.float32)
        return float((self._left(guides_mm).residuals ** 2).sum() + (self._glints(guides_mm) ** 2).sum()) / 2

    def _left(self, guides_mm: np.ndarray) -> Left:
        """What light of these guides leaves of the pixels."""
        return self._probe.left(self._design(guides_mm), self._base)

    def _design(self, guides_mm: np.ndarray) -> Design:
        return self._probe.linearised(self._with(guides_mm), self._base, self._ground.visible(guides_mm))

    def _columns(self, sets_mm: np.ndarray) -> np.ndarray:
        """Columns [M, N, C] of the designs of M sets of guides [M, K, 3]."""
        hypothesis = self._with(sets_mm[0])
        return self._probe.columns(hypothesis, self._base, sets_mm, self._ground.visible)

    def _glints(self, guides_mm: np.ndarray) -> np.ndarray:
        """Residuals of the glints, weighed as those of the probe's pixels are."""
        return self._ground.glints.residuals(guides_mm, self._probe.pixels_a_place)

    def _with(self, guides_mm: np.ndarray) -> Hypothesis:
        return replace(self._base.hypothesis, guides_mm=_plain(guides_mm), shadows=True)


def _plain(guides_mm: np.ndarray) -> Guides:
    return tuple(tuple(float(c) for c in guide) for guide in guides_mm)

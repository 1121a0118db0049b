"""Where the light guides stand: the positions about the lens that predict held-out pixels best."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, cached_property, lru_cache

import numpy as np
from scipy.optimize import least_squares

from endotwin.evidence.glints import Glints
from endotwin.evidence.light_map import LightMap, places_mm
from endotwin.evidence.probe import Fitted, Hypothesis, Probe
from endotwin.light.guides import AT_LENS

Guides = tuple[tuple[float, float, float], ...]
"""Positions in the camera frame, mm."""

RADIUS = 0.12
"""By what guides' places are measured, as a share of the median viewing distance: 2.4 mm at a tip that sees
the wall from 20 mm."""

MOST_GUIDES = 3
SEARCH_PIXELS = 8_000
"""Guides are sought with so many pixels of the probe; those that are kept are polished with all."""

STEPS, TOLERANCE = 12, 1e-3
"""The search ends when positions move by less than this share of the radius, or the loss by less."""

SEEN_GUIDES = 64
"""What so many guides see is kept: of several one is moved at a time."""

DEEPEST = 1.0
"""Of the radius: guides lie at most so far behind the lens."""

ASIDE = 0.1
"""Of the radius: by so much guides are moved to find what their positions change. With less, the
shadows that jump from pixel to pixel hide it."""


def radius_mm(probe: Probe) -> float:
    """RADIUS of the median viewing distance."""
    return RADIUS * float(np.exp(np.median(probe.samples.log_distance.numpy())))


def found_guides(
    probe: Probe, base: Hypothesis, glints: Glints, forced: bool, near_mm: Guides = AT_LENS
) -> Guides:
    """Positions of one to three guides that predict held-out pixels better than ``base``, camera frame; the
    lens where none do. They are sought where they explain the ``glints`` as well, and first ``near_mm``.

    One guide, and a glance at two and three, tell whether a search is worth its time. Two in the plane of the
    lens pass for one behind it: another is believed only beside those before it where they are best. With
    ``forced`` there is always a position: that of the most guides, if none is worth it.
    """
    plain, best = probe.fit(base), None
    if near_mm != AT_LENS:
        near = replace(base, guides_mm=near_mm, shadows=True)
        near = replace(near, guides_mm=Search.of(probe, near, glints).settled())
        if probe.compare(plain, probe.fit(near)).keep:
            return near.guides_mm
    search = Search.of(probe, base, glints)
    if not forced and not search.hints():
        return AT_LENS
    for number in range(1, MOST_GUIDES + 1):
        found = probe.fit(replace(base, guides_mm=search.best(number), shadows=True))
        worth = probe.compare(best or plain, found).keep
        if worth and best is not None:
            worth = probe.compare(settled(probe, best, glints), found).keep
        if worth or (forced and best is None and number == MOST_GUIDES):
            best = found
    return AT_LENS if best is None else Search.of(probe, best.hypothesis, glints).settled()


def settled(probe: Probe, model: Fitted, glints: Glints) -> Fitted:
    """``model`` with its guides where they predict best beside all its effects, if that is elsewhere."""
    return _moved(probe, model, Search.of(probe, model.hypothesis, glints).settled())


def polished(probe: Probe, model: Fitted, glints: Glints) -> Fitted:
    """``model`` with its guides where all of the probe's pixels say that they are, if that is elsewhere."""
    return _moved(probe, model, Search(probe, model.hypothesis, glints).polished())


def _moved(probe: Probe, model: Fitted, guides_mm: Guides) -> Fitted:
    """``model`` with guides at ``guides_mm`` where held-out pixels say that it is better so."""
    moved = probe.fit(replace(model.hypothesis, guides_mm=guides_mm))
    return moved if probe.compare(model, moved).gain_db > 0 else model


class Search:
    """Guide positions that predict a probe's pixels best, shadows included, and where its glints lie."""

    def __init__(self, probe: Probe, base: Hypothesis, glints: Glints):
        self._probe, self._base, self._glints = probe, probe.fit(base), glints
        self._radius_mm = radius_mm(probe)
        self._places_mm = places_mm(self._radius_mm)
        self._lit = probe.visible_to(self._places_mm)
        self._at_risk = np.flatnonzero(~self._lit.all(axis=1))
        self.best = cache(self._best)
        self._seen = lru_cache(SEEN_GUIDES)(lambda guide: probe.visible(np.float32(guide), self._at_risk))

    @classmethod
    def of(cls, probe: Probe, base: Hypothesis, glints: Glints) -> Search:
        """A search with some of the probe's pixels, beside the other effects of ``base``."""
        part, rows = probe.part(SEARCH_PIXELS)
        base = base if base.bounced is None else replace(base, bounced=base.bounced[rows])
        return cls(part, base, glints)

    @cached_property
    def _map(self) -> LightMap:
        return LightMap.of(self._probe, self._base, self._places_mm, self._lit)

    def hints(self) -> bool:
        """Whether one guide, wherever it is best, or two or three where light gathers predict better."""
        more = [start for number in range(2, MOST_GUIDES + 1) for start in self._starts(number)]
        models = [self._probe.fit(self._with(each)) for each in (self.best(1), *more)]
        return any(self._probe.compare(self._base, model).hints for model in models)

    def _best(self, number: int) -> Guides:
        """The best positions of so many guides."""
        return min((self._refined(start) for start in self._starts(number)), key=self._loss)

    def _starts(self, number: int) -> list[np.ndarray]:
        """Where so many guides are sought from: where light gathers, and where the glints say."""
        told = self._glints.guides_mm(number)
        return [*self._map.guides_mm(number), *([told] if len(told) else [])]

    def settled(self) -> Guides:
        """The base's own guides, moved to where they predict best beside its effects."""
        return self._refined(self._base.hypothesis.guides_mm, axes=3)

    def polished(self) -> Guides:
        """As ``settled``, for guides that were sought in the plane of the lens."""
        return self._refined(self._refined(self._base.hypothesis.guides_mm), axes=3)

    def _refined(self, start_mm: Guides | np.ndarray, axes: int = 2) -> Guides:
        """Guides moved from ``start_mm`` [K, 3] by Gauss–Newton, in the plane of the lens, or along 3
        axes."""

        def residuals(x: np.ndarray) -> np.ndarray:
            return self._residuals(self._guides(x, axes))

        def slopes(x: np.ndarray) -> np.ndarray:
            aside = [residuals(x + step) - residuals(x - step) for step in ASIDE * np.eye(len(x))]
            return np.stack(aside, axis=1) / (2 * ASIDE)

        first = self._coordinates(start_mm, axes)
        found = least_squares(residuals, first, slopes, xtol=TOLERANCE, ftol=TOLERANCE, max_nfev=STEPS)
        return _plain(self._guides(found.x, axes))

    def _coordinates(self, guides_mm: Guides | np.ndarray, axes: int) -> np.ndarray:
        """The first so many coordinates of K guides in radii, [K · axes]."""
        return np.asarray(guides_mm, np.float64)[:, :axes].ravel() / self._radius_mm

    def _guides(self, x: np.ndarray, axes: int) -> np.ndarray:
        """Guides float32 [K, 3] of those coordinates; none lies before the lens, or DEEPEST behind it."""
        x = x.reshape(-1, axes)
        guides = np.pad(x, ((0, 0), (0, 3 - axes))).astype(np.float32)
        guides[:, 2] = np.clip(guides[:, 2], -DEEPEST, 0)
        return guides * np.float32(self._radius_mm)

    def _loss(self, guides_mm: np.ndarray) -> float:
        return float((self._residuals(np.asarray(guides_mm)) ** 2).sum()) / 2

    def _residuals(self, guides_mm: np.ndarray) -> np.ndarray:
        """Of the pixels under these guides, and of the glints among as many."""
        visible = np.ones((len(self._probe), len(guides_mm)), bool)
        for k, guide in enumerate(guides_mm):
            visible[self._at_risk, k] = self._seen(tuple(map(float, guide)))
        diffuse = self._probe.residuals(self._with(guides_mm), self._base, visible)
        return np.r_[diffuse, self._glints.residuals(guides_mm, len(self._probe))]

    def _with(self, guides_mm: np.ndarray) -> Hypothesis:
        return replace(self._base.hypothesis, guides_mm=_plain(guides_mm), shadows=True)


def _plain(guides_mm: np.ndarray) -> Guides:
    return tuple(tuple(float(c) for c in guide) for guide in guides_mm)

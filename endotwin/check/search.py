"""The search for the reading under which frames agree: one usual mistake at a time, best first."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from endotwin.check.reading import BASES, OPENGL, ORDERS, Lens, Reading, signed_permutations
from endotwin.check.views import Views
from endotwin.check.warp import Disagreement, disagreement

COARSE, MIDDLE = 2_000, 20_000
SCALES = 10.0 ** np.arange(-4, 4.01, 1 / 3)
RATIOS = 1.1 ** np.arange(-15, 16)
SIZES = ((1350, 1080), (1920, 1080), (1280, 1024), (1280, 720), (640, 480), (320, 240), (475, 475))
"""Sizes that images of colonoscopies and their calibrations have."""
SHIFTS = tuple(k for k in range(-10, 11) if k)
KEPT = {"poses": 6}
KEPT_OF_OTHERS = 3
"""How many candidates of a kind are looked at closely."""
ROUGHLY, FINELY = 0.1, 0.002
MOST_MISTAKES = 3
COMPLEXITY = 0.004
"""Cost that one more mistake, or a rarer one, has to save."""
NEEDED_GAIN = 0.15
"""Share of the cost that one more mistake has to save."""


@dataclass(frozen=True)
class Candidate:
    """A reading that differs from another by one kind of mistake.

    Attributes:
        kind: which mistake: "poses", "scale", "lens", "focal", "ray", "mirror", "shift" or "order".
        free: the numbers of the reading to refine, indices into the step of ``Reading.adjusted``; those that
            move together are listed together.
        rarity: how much more than COMPLEXITY it must save.
    """

    kind: str
    reading: Reading
    free: tuple[tuple[int, ...], ...] = ()
    rarity: float = 0.0


@dataclass(frozen=True)
class Found:
    """The reading that fits best, the kinds of mistakes that lead there, and how it fits."""

    reading: Reading
    kinds: tuple[str, ...]
    before: Disagreement
    after: Disagreement


def best_reading(views: Views, start: Reading, tolerated: float, forced: tuple[Candidate, ...] = ()) -> Found:
    """Search from ``start`` until the median residual is at most ``tolerated`` or nothing helps.

    Args:
        forced: alternatives of which one has to be taken first.
    """
    rng = np.random.default_rng(0)
    shuffled = rng.permutation(len(views.pair))
    coarse, middle = shuffled[:COARSE], shuffled[:MIDDLE]
    before = disagreement(views, start, middle)
    reading, kinds, now = start, (), before
    for round_ in range(MOST_MISTAKES):
        if not (forced and round_ == 0) and now.median <= tolerated and now.lands > 0.2:
            break
        choices = list(forced if forced and round_ == 0 else candidates(views, reading, kinds))
        ranked = sorted(choices, key=lambda c: disagreement(views, c.reading, coarse).cost + c.rarity)
        refined = [_refined(views, candidate, middle, ROUGHLY) for candidate in _varied(ranked)]
        best, _ = min(refined, key=lambda pair: pair[1].cost + pair[0].rarity)
        best, fit = _refined(views, best, middle, FINELY)
        gain = now.cost - fit.cost - best.rarity
        if not (forced and round_ == 0) and gain < max(COMPLEXITY, NEEDED_GAIN * now.cost):
            break
        reading, kinds, now = best.reading, (*kinds, best.kind), fit
    return Found(reading, kinds, before, now)


def candidates(views: Views, start: Reading, kinds: tuple[str, ...]) -> Iterator[Candidate]:
    """Every reading that is one usual mistake, of a kind not in ``kinds``, away from ``start``."""
    camera, count = views.sequence.camera, len(views.written)
    if "poses" not in kinds:
        yield from _pose_candidates(start, "scale" in kinds)
    if not {"scale", "poses"} & set(kinds):
        for scale in SCALES:
            yield Candidate("scale", replace(start, scale=start.scale * scale), ((0,),))
    if not {"lens", "focal"} & set(kinds):
        for ratio in RATIOS:
            lens = Lens.of_resized(ratio, ratio).then(start.lens)
            yield Candidate("lens", replace(start, lens=lens), ((1, 2),), 0.001)
            focal = start.lens.adjusted(camera, np.full(2, ratio), np.zeros(2))
            yield Candidate("focal", replace(start, lens=focal), ((1, 2),), 0.001)
        for width, height in SIZES:
            lens = Lens.of_resized(camera.width / width, camera.height / height).then(start.lens)
            yield Candidate("lens", replace(start, lens=lens))
    if "ray" not in kinds:
        yield Candidate("ray", replace(start, ray=start.ray + 1))
    if "mirror" not in kinds:
        for across in "uv":
            yield Candidate("mirror", replace(start, lens=Lens.of_mirrored(camera, across).then(start.lens)))
    if not {"shift", "order"} & set(kinds):
        for shift in SHIFTS:
            if abs(shift) < count / 2:
                yield Candidate(
                    "shift", replace(start, shift=start.shift + shift), rarity=0.0005 * abs(shift)
                )
        for order in ORDERS[1:]:
            if order != "alphabetic" or count > 10:
                yield Candidate("order", replace(start, order=order))


def _pose_candidates(start: Reading, scaled: bool) -> Iterator[Candidate]:
    """Poses taken in another way; their translations in any unit, unless the unit is settled."""
    for base in BASES:
        for axes in signed_permutations():
            flips = all(axes[k][k] for k in range(3))
            if (base == BASES[0] and axes == start.axes) or not (flips or base == BASES[0]):
                continue
            common = axes == OPENGL or (base != BASES[0] and axes == start.axes)
            rarity = (0.0 if common else 0.003) + (0.003 if base in BASES[2:] else 0.0)
            reading = replace(start, base=base, axes=axes)
            yield Candidate("poses", reading, rarity=rarity)
            if not scaled and flips and base in BASES[:2]:
                for scale in SCALES[SCALES != 1]:
                    moved = replace(reading, scale=start.scale * scale)
                    yield Candidate("poses", moved, ((0,),), rarity + COMPLEXITY)


def _varied(ranked: list[Candidate]) -> list[Candidate]:
    """The first few of every kind, so that a coarse rank does not decide between kinds."""
    taken: dict[str, int] = {}
    kept = []
    for candidate in ranked:
        taken[candidate.kind] = taken.get(candidate.kind, 0) + 1
        if taken[candidate.kind] <= KEPT.get(candidate.kind, KEPT_OF_OTHERS):
            kept.append(candidate)
    return kept


def _refined(
    views: Views, candidate: Candidate, part: np.ndarray, reach: float
) -> tuple[Candidate, Disagreement]:
    """The candidate with its free numbers at the least cost, about ``reach`` away, to a thousandth of it."""
    if not candidate.free:
        return candidate, disagreement(views, candidate.reading, part)

    def moved(x: np.ndarray) -> Reading:
        step = np.zeros(7)
        for value, together in zip(x, candidate.free, strict=True):
            step[list(together)] = value
        return candidate.reading.adjusted(views.sequence.camera, step)

    def cost(x: np.ndarray) -> float:
        return disagreement(views, moved(x), part[:COARSE]).cost

    count = len(candidate.free)
    simplex = np.vstack([np.zeros(count), reach * np.eye(count)])
    options = {"initial_simplex": simplex, "maxiter": 40, "xatol": 1e-3 * reach, "fatol": 1e-6}
    best = minimize(cost, np.zeros(count), method="Nelder-Mead", options=options).x
    reading = moved(best)
    return replace(candidate, reading=reading), disagreement(views, reading, part)

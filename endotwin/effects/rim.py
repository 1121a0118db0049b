"""How brightness rises across the edge of the lens circle, where only a processor makes it overshoot."""

from __future__ import annotations

from collections.abc import Sequence as Indices
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.polynomial.polynomial import polyval
from scipy.optimize import OptimizeResult, least_squares
from scipy.special import ndtr, stdtrit

from endotwin.effects.luma import LUMA
from endotwin.sequence import Sequence
from endotwin.sequence.spread import spread

PHOTOS = 32
"""Spread over a sequence, whose rims are looked at."""

ROUND_PX = 1.0
"""Rms distance from a circle within which the edge of the lit area is one."""

SECTORS, GROUPS = 64, 16
"""Of the circle, each with its own profile; and groups of neighbours, which tell how sure their mean is."""

OUTSIDE_PX, INSIDE_PX, BIN_PX = 6.0, 14.0, 0.5
DISTANCE_PX = np.arange(-OUTSIDE_PX, INSIDE_PX, BIN_PX) + BIN_PX / 2
"""Where a profile is known, inwards from the edge."""

LEVEL = DISTANCE_PX > INSIDE_PX / 2
"""Where it is beyond what sharpening reaches."""

DARKEST, BRIGHTEST = 40.0, 190.0
"""Levels, of 255, of profiles whose black is far below and whose overshoot is mostly not clipped."""

DIMMEST, FEWEST = 512, 64
"""Profiles that the mean is of, those least likely to be clipped, and how few are not enough."""

MODEL = 0.01
"""What the mean profile may differ from a blurred and sharpened edge, as a share of its height."""

LOWEST = np.array([-8.0, 0.2, 0.0, 0.3, 0.3, -0.1, -0.01])
HIGHEST = np.array([8.0, 4.0, 4.0, 3.0, 2.0, 0.1, 0.01])
"""Of the edge's place and blur in px, amount and radius in px of the sharpening, height, slope per px, and
curvature per px², if that is looked for: it may pass for an overshoot, so that none would prove to be there
beside it, but without it the amount of one that is there errs by more."""

RADII_PX = (0.7, 1.5, 2.5)
"""That the search begins at."""

CHANCE = 1e-6
"""Greatest probability of an overshoot that is none."""

SURE = 1 / 3
"""Greatest standard error of an amount, as a share of it: it is three of them from none."""


@dataclass(frozen=True)
class Unsharp:
    """An unsharp mask as in ``Processor``, and by what share of its height an edge overshoots from it."""

    amount: float
    radius_px: float
    overshoot: float


def unsharp(sequence: Sequence, frames: Indices[int] | None = None) -> Unsharp | None:
    """The sharpening that a sequence's photos underwent, by the mean profile of the lens circle's edge in
    those of ``frames``, or of all that are used.

    Scenes know nothing of the circle, so what they show beside it is even in the mean, and a lens blurs the
    edge without overshoot: a step Φ(d/σ) is sharpened to Φ(d/σ) + a·(Φ(d/σ) − Φ(d/√(σ² + r²))), clipped at
    black. None unless the overshoot is beyond MODEL by Student's t, and the amount sure; errors are those
    of leaving out one group of neighbouring sectors after another (jackknife), the amount's of MODEL too.
    """
    distance_px, sector = _polar(sequence.lens_mask)
    if distance_px is None:
        return None
    some = sequence.spread(PHOTOS) if frames is None else np.asarray(frames)[spread(len(frames), PHOTOS)]
    photos = (sequence.color(index) for index in some)
    found = np.concatenate([_profiles(photo, distance_px, sector) for photo in photos])
    found = found[np.argsort(found[:, 1])[:DIMMEST]]
    group, profiles = (found[:, 0] * GROUPS / SECTORS).astype(int), found[:, 2:]
    groups = np.unique(group)
    return _sure(profiles, group, groups) if len(found) >= FEWEST and len(groups) > 1 else None


def _sure(profiles: np.ndarray, group: np.ndarray, groups: np.ndarray) -> Unsharp | None:
    """The unsharp mask of the mean of profiles [K, bins] in groups [K], if it is sure."""
    error = np.hypot(profiles.std(axis=0) / np.sqrt(len(profiles)), MODEL)
    mean = profiles.mean(axis=0)
    place = DISTANCE_PX[np.argmax(mean > 0.5)]
    starts = [np.array([place, 0.5, 0.3, radius, 1.0, 0.0]) for radius in RADII_PX]
    fit = min((_fitted(mean, error, start) for start in starts), key=lambda fit: fit.cost)
    best, amount_error = fit.x, _amount_error(fit)
    near = np.clip(best, LOWEST[: len(best)] + 0.01, HIGHEST[: len(best)] - 0.01)
    others = [_fitted(profiles[group != one].mean(axis=0), error, near).x for one in groups]
    jackknife = np.sqrt(len(groups) - 1)
    overshoot_error = jackknife * np.std([_overshoot(other) for other in others])
    amount_error = max(amount_error, jackknife * np.std([other[2] for other in others]))
    least = MODEL + stdtrit(len(groups) - 1, 1 - CHANCE) * overshoot_error
    if _overshoot(best) <= least or amount_error > SURE * best[2]:
        return None
    _, _, amount, radius_px, *_ = _fitted(mean, error, np.r_[near, 0.0]).x
    return Unsharp(float(amount), float(radius_px), float(_overshoot(best)))


def _fitted(mean: np.ndarray, error: np.ndarray, start: np.ndarray) -> OptimizeResult:
    """Parameters within LOWEST and HIGHEST, as many as ``start`` has, of the edge nearest to a mean profile
    [bins]; in the black, where a codec rings, it is not compared."""
    bounds = LOWEST[: len(start)], HIGHEST[: len(start)]
    seen = start[0] - 1 < DISTANCE_PX

    def residuals(parameters: np.ndarray) -> np.ndarray:
        return ((_edge(parameters) - mean) / error)[seen]

    return least_squares(residuals, start, bounds=bounds, loss="soft_l1")


def _amount_error(fit: OptimizeResult) -> float:
    """Standard error of the amount where every bin of the profile errs by itself; inf at its bounds."""
    if fit.active_mask[2:4].any():
        return np.inf
    return float(np.sqrt(np.linalg.pinv(fit.jac.T @ fit.jac)[2, 2]))


def _edge(parameters: np.ndarray) -> np.ndarray:
    """A blurred and sharpened edge at DISTANCE_PX."""
    place, blur, amount, radius = parameters[:4]
    step = ndtr((DISTANCE_PX - place) / blur)
    detail = step - ndtr((DISTANCE_PX - place) / np.hypot(blur, radius))
    return polyval(DISTANCE_PX, parameters[4:]) * np.maximum(step + amount * detail, 0)


def _overshoot(parameters: np.ndarray) -> float:
    """Share by which an edge is at most brighter than what it rises to."""
    return float((_edge(parameters) / polyval(DISTANCE_PX, parameters[4:])).max() - 1)


def _polar(lit: np.ndarray) -> tuple[np.ndarray, np.ndarray] | tuple[None, None]:
    """Distance inwards from the circle in px, and number of the sector, [H, W]; None where ``lit`` [H, W] has
    no round edge but the image's own."""
    edge = lit & (cv2.erode(lit.astype(np.uint8), np.ones((3, 3))) == 0)
    edge[:2] = edge[-2:] = edge[:, :2] = edge[:, -2:] = False
    rows, columns = np.nonzero(edge)
    if len(rows) < SECTORS:
        return None, None
    circle = np.stack([2 * rows, 2 * columns, np.ones(len(rows))], axis=1)
    y, x, rest = np.linalg.lstsq(circle, (rows**2 + columns**2).astype(float))[0]
    radius_px = np.sqrt(max(rest + x**2 + y**2, 0))
    if np.sqrt(np.mean((np.hypot(rows - y, columns - x) - radius_px) ** 2)) > ROUND_PX:
        return None, None
    v, u = np.mgrid[: lit.shape[0], : lit.shape[1]]
    turn = np.arctan2(v - y, u - x) / (2 * np.pi) % 1
    return radius_px - np.hypot(v - y, u - x), np.minimum((SECTORS * turn).astype(int), SECTORS - 1)


def _profiles(photo: np.ndarray, distance_px: np.ndarray, sector: np.ndarray) -> np.ndarray:
    """Of each evenly lit sector of a photo uint8 [H, W, 3] a row [2 + bins]: its number, its level, and the
    luminance at DISTANCE_PX as shares of that."""
    near = (distance_px > -OUTSIDE_PX) & (distance_px < INSIDE_PX)
    bins = len(DISTANCE_PX)
    place = sector[near] * bins + ((distance_px[near] + OUTSIDE_PX) / BIN_PX).astype(int)

    def sums(values: np.ndarray | None = None) -> np.ndarray:
        return np.bincount(place, values, SECTORS * bins).reshape(SECTORS, bins)

    pixels = sums()
    luma, brightest = (sums(v) / np.maximum(pixels, 1) for v in (photo[near] @ LUMA, photo[near].max(axis=1)))
    kept = (pixels > 0).all(axis=1) & (luma[:, LEVEL].min(axis=1) > DARKEST)
    kept &= brightest[:, LEVEL].max(axis=1) < BRIGHTEST
    level = luma[kept][:, LEVEL].mean(axis=1)
    return np.column_stack([np.nonzero(kept)[0], level, luma[kept] / level[:, None]])

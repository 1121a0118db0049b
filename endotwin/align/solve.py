"""Gauss–Newton on the corrections: texture says how photos lie to each other, rims how they lie to the
surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from endotwin.align.corrections import (
    OF_PHOTO,
    PLACED,
    SHARED,
    Corrections,
    own_covariance,
    own_spread,
    shared_spread,
)
from endotwin.align.photos import Photo
from endotwin.align.rims import Rim, painted, rim
from endotwin.align.scene import Scene
from endotwin.align.within import HUBER, ROUNDS, Within, within
from endotwin.robust import robust_std
from endotwin.run.ahead import ahead
from endotwin.run.threads import THREADS

TEXTURE_ALIKE, RIM_ALIKE = 10.0, 2.0
"""What the model of light lacks errs alike in so many vertices, and in so many spots of the blur beside
rims."""


@dataclass(frozen=True, eq=False)
class Looked:
    """What F photos tell at one state of the corrections: matrix [F, 9, F, 9] and right-hand side [F, 9]; and
    the robust ``width`` of what their texture is off by."""

    matrix: np.ndarray
    right: np.ndarray
    width: float


def paint_of(scene: Scene, texture: Within) -> np.ndarray:
    """What the ``texture`` of vertices that are looked at paints on all, see ``painted``."""
    known = np.isfinite(texture.log_albedo)
    return painted(scene.surface, scene.points_mm[known], texture.log_albedo[known])


def look(
    scene: Scene, photos: dict[int, Photo], poses: np.ndarray, frames: np.ndarray, sigma_px: float
) -> Looked:
    """What the photos of ``frames`` [F] tell about their ``poses`` [N, 4, 4], blurred by ``sigma_px``."""
    texture = within(scene, photos, poses, frames, sigma_px)
    paint = paint_of(scene, texture)
    seen = zip(frames.tolist(), texture.views, strict=True)
    found = ahead(lambda each: rim(scene, photos[each[0]], each[1], paint, texture.light), seen, THREADS)
    matrix, right = texture.normal_equations(len(frames))
    matrix, right = matrix / TEXTURE_ALIKE, right / TEXTURE_ALIKE
    alike = RIM_ALIKE * 4 * np.pi * sigma_px**2
    for number, beside in enumerate(found):
        own, pull = rim_equations(beside)
        matrix[number, :, number] += own / alike
        right[number] += pull / alike
    return Looked(matrix, right, texture.width)


def rim_equations(seen: Rim) -> tuple[np.ndarray, np.ndarray]:
    """Matrix [9, 9] and right-hand side [9] of a photo's twist and intrinsics, in units of the residuals'
    variance."""
    if len(seen.residual) < 100:
        return np.zeros((OF_PHOTO, OF_PHOTO)), np.zeros(OF_PHOTO)
    left, weight, width = even(seen)
    total = np.bincount(seen.stretch, weight)
    slopes = seen.slopes - np.stack(
        [(np.bincount(seen.stretch, weight * x) / total)[seen.stretch] for x in seen.slopes.T], axis=1
    )
    weighted = slopes * weight[:, None]
    return weighted.T @ slopes / width**2, -weighted.T @ left / width**2


def even(seen: Rim) -> tuple[np.ndarray, np.ndarray, float]:
    """A rim's residuals [P] less the mean of each stretch, their weights [P] and width."""
    weight = np.ones(len(seen.residual))
    for _ in range(ROUNDS):
        mean = np.bincount(seen.stretch, weight * seen.residual) / np.bincount(seen.stretch, weight)
        left = seen.residual - mean[seen.stretch]
        width = robust_std(left, 1e-3)
        weight = 1 / np.maximum(1, np.abs(left) / (HUBER * width))
    return left, weight, width


def step(
    now: Corrections, told: Looked, frames: np.ndarray, lens: bool, own: bool
) -> tuple[Corrections, float]:
    """The corrections after a Gauss–Newton step, and how far that went: the mean over what moved of squares
    of standard deviations by which all photos tell it. Intrinsics move if ``lens`` says so, and what the
    photos of ``frames`` [F] have of their own if ``own`` does."""
    count, shared = len(frames), SHARED if lens else PLACED
    flat = told.matrix.reshape(OF_PHOTO * count, OF_PHOTO * count)
    to_photos = now.slopes()[frames][..., :shared].reshape(OF_PHOTO * count, shared)
    precision, before = np.diag(1 / shared_spread()[:shared] ** 2), now.shared[:shared]
    if own:
        to_photos = np.hstack([to_photos, np.kron(np.eye(count), np.eye(OF_PHOTO, 6))])
        kernel = np.linalg.inv(own_covariance(frames))
        precision = scipy.linalg.block_diag(precision, np.kron(kernel, np.diag(1 / own_spread() ** 2)))
        before = np.r_[before, now.own[frames].reshape(-1)]
    normal = to_photos.T @ flat @ to_photos + precision
    right = to_photos.T @ told.right.reshape(-1) - precision @ before
    found = scipy.linalg.cho_solve(scipy.linalg.cho_factor(normal), right)
    moved = found[shared:].reshape(count, 6) if own else np.zeros((count, 6))
    stepped = now.stepped(np.r_[found[:shared], np.zeros(SHARED - shared)], moved, frames)
    return stepped, float(right @ found) / len(found)

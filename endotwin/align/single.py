"""One photo's own pose beside a fitted twin."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from endotwin.align.corrections import pose_precision
from endotwin.align.motion import moved, twists_between
from endotwin.align.photos import DARKEST, Photo, log_blurred
from endotwin.align.rims import least_within, moving_slopes
from endotwin.align.scene import Scene
from endotwin.align.views import band_px
from endotwin.align.within import HUBER
from endotwin.robust import robust_std

BLURS = (0.006, 0.003, 0.0015, 0.0015)
"""Widths of the blurs, coarse to fine, of the image's width."""

LEAST_BLUR_PX = 0.7

ALIKE = 20.0
"""What a rendering lacks errs alike in so many pixels of a blur's area."""

LEAST_PIXELS = 100


def placed(
    scene: Scene,
    photo: Photo,
    T_world_camera: np.ndarray,
    part: np.ndarray,
    rendered: Callable[[np.ndarray], np.ndarray],
) -> np.ndarray:
    """The pose [4, 4] near ``T_world_camera`` from which the twin looks most like ``part`` (bool [H, W]) of a
    photo, which need not be equally bright. Gauss–Newton, coarse to fine, under the prior of a registration.

    Args:
        rendered: from a pose to the twin's rendering, [H, W, 3], display-encoded.
    """
    T = T_world_camera
    for share in BLURS:
        sigma_px = max(LEAST_BLUR_PX, share * scene.camera.width)
        distances = scene.distances(scene.caster.cast(scene.camera, T))
        met = (part & (distances > 0)).astype(np.float32)
        shown, holds = photo.blurred(sigma_px, met)
        level = rendered(T).mean(axis=2, dtype=np.float32)
        predicted, told = log_blurred(level, met * photo.shown, sigma_px)
        pixel = np.flatnonzero(holds & told & (predicted > np.log(DARKEST)))
        if len(pixel) < LEAST_PIXELS:
            return T_world_camera
        nearest_mm = least_within(distances, band_px(sigma_px)).reshape(-1)[pixel].astype(np.float64)
        slopes = moving_slopes(scene, predicted, pixel, nearest_mm)[:, :6]
        left = (shown - predicted).reshape(-1)[pixel].astype(np.float64)
        left -= np.median(left)
        width = robust_std(left, 1e-3)
        weight = 1 / np.maximum(1, np.abs(left) / (HUBER * width))
        weight /= width**2 * ALIKE * 4 * np.pi * sigma_px**2
        slopes = slopes - np.average(slopes, axis=0, weights=weight)
        gone = twists_between(T_world_camera[None], T[None])[0]
        prior = pose_precision()
        normal = (slopes * weight[:, None]).T @ slopes + prior
        T = moved(T, np.linalg.solve(normal, -slopes.T @ (weight * left) - prior @ gone))
    return T

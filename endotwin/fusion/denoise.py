"""Noise of depth that differs from pixel to pixel averages out within a pixel's neighbourhood."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import cv2
import numpy as np

from endotwin.fusion.views import View
from endotwin.robust import robust_std

STEP_SIGMAS = 3.0
"""Neighbours whose distances differ by so many standard deviations of the noise count for little."""

ROW_STEP = 4
"""The noise is measured along every so manieth row."""

WIDEST_PX = 4.0
ABSENT = 50.0
"""Logarithm of the distance that stands for none: so far from any that its weight is 0."""


def pixel_noise(views: Iterable[View]) -> float:
    """Standard deviation of the noise that differs from pixel to pixel, relative to the distance.

    From second differences along the rows (of variance 6σ²), in the median, so that rims do not count.
    """
    spreads = [0.0]
    for view in views:
        bend = np.abs(np.diff(np.log(view.distance_mm[::ROW_STEP]), n=2, axis=1))
        bend = bend[np.isfinite(bend)]
        if len(bend):
            spreads.append(robust_std(bend) / 6**0.5)
    return float(np.median(spreads[1:] or spreads))


def denoised(view: View, noise: float, width_px: float) -> View:
    """``view`` after a bilateral filter (Tomasi & Manduchi 1998) of the logarithms of its distances.

    Logarithms, because the noise is relative; bilateral, because a mean across the rim of a fold would lie on
    neither side. Nothing is measured after it that was not before.

    Args:
        noise: standard deviation of the distances, relative to the distance.
        width_px: standard deviation of the neighbourhood, in pixels, at most WIDEST_PX.
    """
    measured = np.isfinite(view.distance_mm)
    logarithm = np.log(view.distance_mm, where=measured, out=np.full(measured.shape, ABSENT, np.float32))
    width_px = min(width_px, WIDEST_PX)
    smooth = cv2.bilateralFilter(logarithm, 2 * round(2 * width_px) + 1, STEP_SIGMAS * noise, width_px)
    return replace(view, distance_mm=np.where(measured, np.exp(smooth), np.nan).astype(np.float32))

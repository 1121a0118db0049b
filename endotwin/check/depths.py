"""Depth maps made ready for warping: their noise measured, their jumps cut out, their noise smoothed."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from endotwin.robust import robust_std

LEAST_COSINE = 0.25
"""Pixels whose ray is farther off the optical axis are left alone: z-depth says nothing at 90°."""

SMOOTH_BEND = 0.003
"""Relative second difference of a smooth surface, at most, where there is no noise."""

QUIET = 1e-3
"""Relative noise that depth is smoothed to. What is left tilts the slopes by which half a pixel is told: at
1 % of white noise and no smoothing, an offset of .5 px was measured as .02 to .18 px."""


@dataclass(frozen=True)
class DepthMap:
    """One frame's depth, ready to be warped from and onto.

    Attributes:
        inverse: 1/z float32 [H, W], smoothed as far as its noise asks for; NaN at jumps and where there is
            no depth. Planes are linear in it, so that bilinear lookup is exact on them.
        noise: relative noise of the depth as measured, quantisation included.
        left: relative noise that smoothing leaves.
    """

    inverse: np.ndarray
    noise: float
    left: float


def prepared(depth_mm: np.ndarray, cosine: np.ndarray) -> DepthMap:
    """Prepare z-depth float32 [H, W], NaN where there is none; ``cosine`` [H, W] is each ray's z."""
    usable = np.isfinite(depth_mm) & (depth_mm > 0) & (cosine > LEAST_COSINE)
    inverse = np.where(usable, 1 / np.where(usable, depth_mm, 1), np.nan).astype(np.float32)
    bends = [_bend(inverse, axis) for axis in (0, 1)]
    noise = float(np.hypot(_spread(bends), _step(depth_mm[usable])))
    smooth = (bends[0] < SMOOTH_BEND + 6 * noise) & (bends[1] < SMOOTH_BEND + 6 * noise)
    flat = cv2.erode(smooth.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) > 0
    inverse[~flat] = np.nan
    radius = noise / QUIET / (2 * np.sqrt(np.pi))
    if radius > 0.5:
        inverse, left = _smoothed(inverse, radius), min(noise, QUIET)
    else:
        left = noise
    return DepthMap(inverse, noise, left)


def lookup(stack: np.ndarray, layer: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Bilinear values float64 [N] of ``stack`` [F, H, W] at ``layer`` [N] and pixels ``uv`` [N, 2]; NaN
    outside."""
    height, width = stack.shape[1:]
    inside = np.isfinite(uv).all(axis=1) & (uv >= 0).all(axis=1) & (uv < (width - 1, height - 1)).all(axis=1)
    u, v = np.where(inside, uv[:, 0], 0), np.where(inside, uv[:, 1], 0)
    column, row = u.astype(int), v.astype(int)
    part_u, part_v = u - column, v - row
    flat, start = stack.reshape(-1), (layer * height + row) * width + column
    above = flat[start] * (1 - part_u) + flat[start + 1] * part_u
    below = flat[start + width] * (1 - part_u) + flat[start + width + 1] * part_u
    return np.where(inside, above * (1 - part_v) + below * part_v, np.nan)


def _bend(inverse: np.ndarray, axis: int) -> np.ndarray:
    """Relative second difference of 1/z along an axis [H, W]; inf at the border, NaN beside no depth."""
    bend = np.full_like(inverse, np.inf)
    inner = (slice(1, -1), slice(None)) if axis == 0 else (slice(None), slice(1, -1))
    second = np.diff(inverse, 2, axis=axis)
    bend[inner] = np.abs(second) / inverse[inner]
    return bend


def _spread(bends: list[np.ndarray]) -> float:
    """Relative noise from second differences, whose variance is six times the noise's."""
    sparse = [bend[1::4, 1::3] for bend in bends]
    seen = np.concatenate([bend[np.isfinite(bend)] for bend in sparse])
    return robust_std(seen) / np.sqrt(6)


def _step(depth_mm: np.ndarray) -> float:
    """Relative noise of the quantisation of depths [N]: its least step / √12."""
    levels = np.unique(depth_mm[:: max(len(depth_mm) // 20000, 1)])
    if len(levels) < 2:
        return 0.0
    return float(np.diff(levels).min() / np.sqrt(12) / np.median(levels))


def _smoothed(inverse: np.ndarray, radius: float) -> np.ndarray:
    """Gaussian mean of the neighbours with a value; kept where most of them have one."""
    known = np.isfinite(inverse).astype(np.float32)
    weight = cv2.GaussianBlur(known, (0, 0), radius)
    total = cv2.GaussianBlur(np.where(known > 0, inverse, 0).astype(np.float32), (0, 0), radius)
    kept = (known > 0) & (weight > 0.75)
    return np.where(kept, total / np.maximum(weight, 1e-6), np.nan).astype(np.float32)

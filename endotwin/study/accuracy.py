"""How far predicted depth is from measured depth: the field's numbers, of one image at a time.

Eigen et al., *Depth Map Prediction from a Single Image*, NeurIPS 2014. A number of a sequence is the mean
over its images.
"""

from __future__ import annotations

import numpy as np

NEAREST_MM, FARTHEST_MM = 0.1, 100.0
"""What predictions are clipped to; depth beyond C3VD's 100 mm counts as none."""

METRICS = ("abs_rel", "sq_rel", "rmse", "rmse_log", "d1", "d2", "d3")
NAMES = dict(
    zip(METRICS, ("AbsRel", "SqRel mm", "RMSE mm", "RMSElog", "δ<1.25", "δ<1.25²", "δ<1.25³"), strict=True)
)
RATIO = 1.25

EDGES_MM = np.arange(0.0, FARTHEST_MM + 1, 10.0)
"""Bins of error against depth."""


def accuracy(depth_mm: np.ndarray, predicted_mm: np.ndarray) -> dict[str, float]:
    """``METRICS`` of one image over the pixels that have depth.

    Args:
        depth_mm: [H, W], NaN where there is none. predicted_mm: [H, W], clipped to C3VD's range.

    Returns:
        AbsRel = mean |p−d|/d; SqRel = mean (p−d)²/d in mm; RMSE in mm; RMSElog of natural logarithms; δ: the
        share with max(p/d, d/p) < 1.25, 1.25², 1.25³. NaN where no pixel has depth.
    """
    d, p = valid(depth_mm, predicted_mm)
    if not len(d):
        return dict.fromkeys(METRICS, float("nan"))
    error, ratio = p - d, np.maximum(p / d, d / p)
    return {
        "abs_rel": float(np.mean(np.abs(error) / d)),
        "sq_rel": float(np.mean(error**2 / d)),
        "rmse": float(np.sqrt(np.mean(error**2))),
        "rmse_log": float(np.sqrt(np.mean(np.log(p / d) ** 2))),
        **{f"d{k}": float(np.mean(ratio < RATIO**k)) for k in (1, 2, 3)},
    }


def valid(depth_mm: np.ndarray, predicted_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth and clipped prediction, float64 [P], of the pixels that have depth, within FARTHEST_MM."""
    has = (depth_mm > 0) & (depth_mm <= FARTHEST_MM)
    return (
        depth_mm[has].astype(np.float64),
        np.clip(predicted_mm[has].astype(np.float64), NEAREST_MM, FARTHEST_MM),
    )


def median_scaled(depth_mm: np.ndarray, predicted_mm: np.ndarray) -> np.ndarray:
    """The prediction times the one factor that gives it the median of the depth, where that is known."""
    d, p = valid(depth_mm, predicted_mm)
    return predicted_mm * (np.median(d) / np.median(p)) if len(d) else predicted_mm


def error_by_depth(depth_mm: np.ndarray, predicted_mm: np.ndarray) -> np.ndarray:
    """Sum of |p−d|/d and number of pixels in each bin of ``EDGES_MM``, float64 [2, bins]."""
    d, p = valid(depth_mm, predicted_mm)
    return np.stack(
        [np.histogram(d, EDGES_MM, weights=weights)[0] for weights in (np.abs(p - d) / d, np.ones_like(d))]
    )

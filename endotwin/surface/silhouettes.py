"""Silhouettes: where one pixel sees two surfaces."""

from __future__ import annotations

import cv2
import numpy as np

SILHOUETTE = 0.1
"""Depth that changes by more than this part of it within a pixel's neighbours is a silhouette."""


def discontinuities(depth_mm: np.ndarray) -> np.ndarray:
    """Bool [H, W]: pixels beside a jump of depth (or of distance) float32 [H, W], or where it ends (NaN
    or 0)."""
    kernel = np.ones((3, 3), np.uint8)
    depth_mm = np.nan_to_num(depth_mm, posinf=0)
    farthest, nearest = cv2.dilate(depth_mm, kernel), cv2.erode(depth_mm, kernel)
    return (farthest > 0) & ~(farthest - nearest <= SILHOUETTE * depth_mm)


def dilated(mask: np.ndarray, radius: int) -> np.ndarray:
    """Bool [H, W]: pixels within a square of ``radius`` about those of ``mask``."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * radius + 1,) * 2, np.uint8)) > 0

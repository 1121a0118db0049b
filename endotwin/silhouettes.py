"""Silhouettes: where one pixel sees two surfaces."""

from __future__ import annotations

import cv2
import numpy as np

JUMP = 0.1
"""Depth that changes by more than this part of it within a pixel's neighbours is a silhouette."""


def discontinuities(depth_mm: np.ndarray) -> np.ndarray:
    """Bool [H, W]: pixels next to a jump of depth float32 [H, W], or to a pixel without one (NaN)."""
    kernel = np.ones((3, 3), np.uint8)
    known = np.isfinite(depth_mm)
    farthest = cv2.dilate(np.where(known, depth_mm, np.inf).astype(np.float32), kernel)
    nearest = cv2.erode(np.where(known, depth_mm, np.float32(0)).astype(np.float32), kernel)
    return ~(farthest - nearest <= JUMP * depth_mm)

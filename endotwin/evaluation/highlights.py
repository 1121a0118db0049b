"""Highlights of a picture: small, bright and whiter than what surrounds them; and how alike those of two are.

What a highlight is, is read off the picture alone, so that renders of any method are held to the same rule.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.stats import wasserstein_distance

OUTSHINES = 0.1
"""Display values, in green and in blue, by which a highlight is brighter than its surroundings."""

SURROUNDINGS = 0.05
"""Diameter of the surroundings, in widths of the picture: no highlight is as wide."""

NEAR_PX = 3
"""Highlights that lie so near to each other are the same."""


@dataclass(frozen=True)
class Alike:
    """How alike the highlights of a photo and of its rendering are; NaN where there are none to compare.

    Attributes:
        precision: share of the rendering's highlight pixels within NEAR_PX of one of the photo's. recall:
            share of the photo's within NEAR_PX of one of the rendering's. sizes: earth mover's distance
            between the two distributions of log₂ of a highlight's area in pixels.
        dull: bool [H, W], pixels with no highlight of either within NEAR_PX.
    """

    precision: float
    recall: float
    sizes: float
    dull: np.ndarray

    @classmethod
    def of(cls, photo: np.ndarray, render: np.ndarray, valid: np.ndarray) -> Alike:
        """Of two pictures [H, W, 3] in [0, 1], where ``valid`` [H, W]."""
        true, shown = (highlights(picture, valid) for picture in (photo, render))
        near_true, near_shown = _grown(true), _grown(shown)
        return cls(
            precision=_share(near_true, shown),
            recall=_share(near_shown, true),
            sizes=_size_distance(true, shown),
            dull=valid & ~near_true & ~near_shown,
        )


def highlights(picture: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Bool [H, W]: pixels, among the ``valid`` [H, W], that outshine what surrounds them in green and blue.

    The white top-hat (Serra 1982): what is left of a picture after its opening by a disk. Light that is
    mirrored is white; of what tissue scatters, red is most. Pixels that are not valid count as bright: were
    they dark, every strip of tissue between two holes would outshine its surroundings.
    """
    size = 2 * round(SURROUNDINGS * picture.shape[1] / 2) + 1
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    bluish = np.where(valid, picture[..., 1:].min(axis=2), 1).astype(np.float32)
    return valid & (cv2.morphologyEx(bluish, cv2.MORPH_TOPHAT, disk) > OUTSHINES)


def _grown(mask: np.ndarray) -> np.ndarray:
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * NEAR_PX + 1, 2 * NEAR_PX + 1))
    return cv2.dilate(mask.view(np.uint8), disk) > 0


def _share(found: np.ndarray, of: np.ndarray) -> float:
    return float(found[of].mean()) if of.any() else float("nan")


def log_areas(mask: np.ndarray) -> np.ndarray:
    """log₂ of the area, px, of each of the highlights of ``mask`` [H, W]."""
    return np.log2(cv2.connectedComponentsWithStats(mask.view(np.uint8))[2][1:, cv2.CC_STAT_AREA])


def _size_distance(one: np.ndarray, other: np.ndarray) -> float:
    sizes = [log_areas(mask) for mask in (one, other)]
    return float(wasserstein_distance(*sizes)) if all(len(each) for each in sizes) else float("nan")

"""Photos as the alignment looks at them: logarithms of blurred brightness, without what is clipped."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from endotwin.run.ahead import ahead
from endotwin.run.threads import THREADS
from endotwin.sequence import Sequence

CLIPPED = 250
DARKEST = 0.02
"""Display value below which noise rules the logarithm."""

BESIDE_PX = 5
"""So many pixels beside the lens circle and beside clipped highlights are left out."""


@dataclass(frozen=True)
class Photo:
    """A photo, H × W.

    Attributes:
        level: float32 [H, W], mean of the channels, display-encoded, in [0, 1]. shown: float32 [H, W], 1
            where it tells something.
    """

    level: np.ndarray
    shown: np.ndarray

    def blurred(self, sigma_px: float, shown: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """ln of the level [H, W] blurred over what is shown (and ``shown`` [H, W] says), and bool [H, W]
        where that holds."""
        return log_blurred(self.level, self.shown if shown is None else self.shown * shown, sigma_px)


def log_blurred(level: np.ndarray, shown: np.ndarray, sigma_px: float) -> tuple[np.ndarray, np.ndarray]:
    """ln of ``level`` float32 [H, W] blurred by a Gaussian over the pixels ``shown`` (0 or 1), and bool [H,
    W] where most of what was blurred was shown."""
    weight = cv2.GaussianBlur(shown, (0, 0), sigma_px)
    mean = cv2.GaussianBlur(level * shown, (0, 0), sigma_px) / np.maximum(weight, 1e-3)
    holds = (weight > 0.85) & (shown > 0) & (mean > DARKEST)
    return np.log(np.maximum(mean, 1e-3)), holds


def gradient(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Slopes along u and v of an image float32 [H, W], a pixel."""
    return cv2.Scharr(image, cv2.CV_32F, 1, 0) / 32, cv2.Scharr(image, cv2.CV_32F, 0, 1) / 32


def read_photos(sequence: Sequence, frames: Iterable[int]) -> dict[int, Photo]:
    """The photos of ``frames``, by frame."""
    frames, inside = list(frames), well_inside(sequence.lens_mask)
    found = ahead(lambda frame: photo_of(sequence.color(frame), inside), frames, THREADS)
    return dict(zip(frames, found, strict=True))


def well_inside(lens_mask: np.ndarray) -> np.ndarray:
    """Uint8 [H, W]: 1 off the edge of ``lens_mask``, bool [H, W]."""
    return cv2.erode(lens_mask.astype(np.uint8), np.ones((BESIDE_PX, BESIDE_PX), np.uint8))


def photo_of(color: np.ndarray, inside: np.ndarray) -> Photo:
    """Of colours uint8 [H, W, 3], where ``inside`` [H, W] is 1."""
    clipped = (color.max(axis=2) >= CLIPPED).astype(np.uint8)
    shown = inside * (1 - cv2.dilate(clipped, np.ones((BESIDE_PX, BESIDE_PX), np.uint8)))
    return Photo(color.mean(axis=2, dtype=np.float32) / 255, shown.astype(np.float32))

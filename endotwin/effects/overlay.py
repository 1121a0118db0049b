"""What the processor draws over the picture: black corners that leave an octagon, and a line of text."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import cv2
import numpy as np

from endotwin.effects.effect import Effect, parameter
from endotwin.sequence import Sequence

FONT, WEIGHT = cv2.FONT_HERSHEY_SIMPLEX, 12
"""Letters are so many times as high as their strokes are wide."""

MARGIN = 1.0
"""Between the text and the image's edges, in heights of its letters."""

WHITE = 0.9
"""Display value of the text."""


@dataclass(frozen=True)
class Overlay(Effect):
    """Four black triangles in the corners, and text at the lower right, over whatever is there: as the frames
    of C3VD have it, whose processor wrote the scope's name into them.

    Attributes:
        corner: legs of the triangles, as a share of the image's height; 0: no octagon.
        letters: height of the text, as a share of the image's height; 0: no text. text: what it says.
    """

    name: ClassVar[str] = "overlay"
    corner: float = parameter(0.25, 0.0, 0.5)
    letters: float = parameter(0.03, 0.0, 0.2)
    text: str = "CF-H190L"

    def hides(self, height: int, width: int) -> np.ndarray:
        """Bool [H, W]: pixels that it draws over."""
        stop, text = _drawn(self, height, width)
        return stop | (text > 0)

    def recorded(self, color: np.ndarray) -> np.ndarray:
        """Display values float32 [H, W, 3] with the overlay drawn over them."""
        stop, text = _drawn(self, *color.shape[:2])
        shown = np.where(stop[..., None], np.float32(0), color)
        return shown + text[..., None] * (np.float32(WHITE) - shown)

    @classmethod
    def evidence(cls, sequence: Sequence) -> tuple[Overlay | None, str]:
        """Never by itself: its corners are told as the lens's edge, and its text hides what no view needs."""
        return None, "rendered on request: what a processor draws over its pictures is no part of the scene"


@lru_cache(maxsize=4)
def _drawn(overlay: Overlay, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Bool [H, W], the corners; float32 [H, W], how much of each pixel the text covers."""
    leg_px = overlay.corner * height
    x, y = (np.minimum(np.arange(size), np.arange(size)[::-1]) + 0.5 for size in (width, height))
    stop = x + y[:, None] < leg_px
    text, size_px = np.zeros((height, width), np.uint8), round(overlay.letters * height)
    if size_px > 0:
        stroke_px, margin_px = max(1, size_px // WEIGHT), round(MARGIN * size_px)
        scale = cv2.getFontScaleFromHeight(FONT, size_px, stroke_px)
        (length_px, _), _ = cv2.getTextSize(overlay.text, FONT, scale, stroke_px)
        place = (width - margin_px - length_px, height - margin_px)
        cv2.putText(text, overlay.text, place, FONT, scale, 255, stroke_px, cv2.LINE_AA)
    return stop, text / np.float32(255)

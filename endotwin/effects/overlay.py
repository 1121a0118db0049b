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

PHOTOS = 8
"""Spread over a sequence, whose mean tells where its corners end."""

NEAR_PX = 1.0
"""Mean distance from the edges of an octagon within which the photos' black ends."""

BESIDE_PX = 8
"""Off the edges of the octagon, on either side, where a picture is lit or black whatever a codec did."""


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
        """Black corners of one size, cut at 45°, which no lens draws. What a text says is not read."""
        leg_px = legs_px(sequence.lens_mask)
        if leg_px is None:
            return None, "rendered on request: the photos have no four black corners that leave an octagon"
        corner = _edge_px(sequence, leg_px) / sequence.camera.height
        return cls(corner, letters=0.0), f"black corners leave an octagon: {corner:.3f} of the height"


def legs_px(lit: np.ndarray) -> float | None:
    """Legs of four triangles in the corners that are what is dark in ``lit`` [H, W], but for NEAR_PX of their
    edges' length; None where they are not."""
    height, width = lit.shape
    leg_px = float(np.sqrt(np.count_nonzero(~lit) / 2))
    if not NEAR_PX < leg_px <= height / 2:
        return None
    stop, _ = _drawn(Overlay(leg_px / height, letters=0.0), height, width)
    wrong = np.count_nonzero(stop == lit)
    return leg_px if wrong <= NEAR_PX * 4 * np.sqrt(2) * leg_px else None


def _edge_px(sequence: Sequence, leg_px: float) -> float:
    """Legs of the triangles by where the mean photo is half as bright as beside them.

    The surround that a mask tells is wider by as much as a codec or a sharpening processor reaches.
    """
    chosen = sequence.spread(PHOTOS)
    mean = np.mean([sequence.color(index).max(axis=2) for index in chosen], axis=0)
    x, y = (np.minimum(np.arange(size), np.arange(size)[::-1]) for size in mean.shape[::-1])
    line = x + y[:, None]
    lines = np.arange(max(int(leg_px) - BESIDE_PX, 0), int(leg_px) + BESIDE_PX)
    level = np.array([np.median(mean[line == number]) for number in lines])
    return float(lines[np.argmax(level > level[-1] / 2)]) + 0.5


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

"""The recorder: every frame is a JPEG picture, as in Motion JPEG."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np

from endotwin.effects.effect import Effect, parameter
from endotwin.effects.jpeg import quality_of
from endotwin.sequence import Sequence

FILES = 8
"""Photos, spread over a sequence, whose files are asked for their quality."""


@dataclass(frozen=True)
class Codec(Effect):
    """Display values through libjpeg and back: 8 bits, colour differences at half the size (4:2:0), cosine
    coefficients of blocks of 8×8 rounded as coarsely as the quality says.

    Attributes:
        quality: libjpeg's, 1 to 100.
    """

    name: ClassVar[str] = "codec"
    quality: float = parameter(75.0, 1.0, 100.0)

    def recorded(self, color: np.ndarray) -> np.ndarray:
        """Display values float32 [H, W, 3] as they are played back."""
        options = (
            *(cv2.IMWRITE_JPEG_QUALITY, round(self.quality)),
            *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420),
        )
        levels = np.rint(np.clip(color[..., ::-1], 0, 1) * np.float32(255)).astype(np.uint8)
        coded = cv2.imencode(".jpg", levels, options)[1]
        return cv2.imdecode(coded, cv2.IMREAD_COLOR)[..., ::-1].astype(np.float32) / np.float32(255)

    @classmethod
    def evidence(cls, sequence: Sequence) -> tuple[Codec | None, str]:
        """Of JPEG files by their own tables, of others by what a JPEG's steps left in their pixels."""
        qualities = []
        for file in (sequence.color_files[index] for index in sequence.spread(FILES)):
            quality = quality_of(file) if sequence.scale == 1 else None
            if quality is None:
                return None, "rendered on request: the photos are no JPEG files and show no steps of one"
            qualities.append(quality)
        quality = float(np.median(qualities))
        return cls(quality), f"the photos were coded as JPEG pictures of quality {quality:g}"

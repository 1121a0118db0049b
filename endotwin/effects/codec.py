"""The recorder: every frame is a JPEG picture, as in Motion JPEG."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
from PIL import Image

from endotwin.effects.effect import Effect, parameter
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
        """Of JPEG files by their own tables; what other files lost to a codec before is not told."""
        files = sequence.color_files[:: max(len(sequence) // FILES, 1)]
        qualities = [quality for quality in map(_quality_of, files) if quality is not None]
        if sequence.scale != 1 or len(qualities) < len(files):
            return None, "rendered on request: photos that are no JPEG files as they were coded do not tell"
        quality = float(np.median(qualities))
        return cls(quality), f"the photos are JPEG files of quality {quality:g}"


def _quality_of(file: Path) -> float | None:
    """The quality at which libjpeg's steps of brightness are nearest to a JPEG file's, by their logarithms;
    None of other files."""
    steps = _steps(file)
    if steps is None:
        return None
    return 1.0 + np.abs(np.log(_steps_by_quality()) - np.log(steps)).mean(axis=1).argmin()


@cache
def _steps_by_quality() -> np.ndarray:
    """Steps of libjpeg's luminance, [100, 64], of qualities 1 to 100."""
    tables = []
    for quality in range(1, 101):
        coded = BytesIO()
        Image.new("L", (8, 8)).save(coded, "JPEG", quality=quality)
        tables.append(_steps(coded))
    return np.stack(tables)


def _steps(file: Path | BytesIO) -> np.ndarray | None:
    """Steps, [64], in which a JPEG file keeps the cosine coefficients of brightness; None of other files."""
    try:
        with Image.open(file) as photo:
            tables = getattr(photo, "quantization", None)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None
    return np.asarray(tables[0], float) if tables and 0 in tables else None

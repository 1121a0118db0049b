"""The video processor: a tone curve, and luminance that is sharpened."""

from __future__ import annotations

import math
from collections.abc import Sequence as Indices
from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
import torch

from endotwin.effects import rim
from endotwin.effects.effect import Effect, parameter
from endotwin.effects.luma import LUMA
from endotwin.effects.tone import Tone
from endotwin.sequence import Sequence

CLOSE = 0.01
"""Share of what sharpening did to a pixel that is left when it is undone: less than a level."""


@dataclass(frozen=True)
class Processor(Effect):
    """A tone curve (``Tone``) of display values, then an unsharp mask of their luminance Y, C'' = C' +
    sharpening·(Y − G ∗ Y) with a Gaussian G; clipped to [0, 1].

    Attributes:
        contrast: of the curve, which leaves 0, ½ and 1 in their places. sharpening: of the luminance.
        radius: standard deviation of G, px.
    """

    name: ClassVar[str] = "processor"
    contrast: float = parameter(0.3, 0.0, 1.0)
    sharpening: float = parameter(0.6, 0.0, 4.0)
    radius: float = parameter(1.2, 0.3, 10.0)

    def recorded(self, color: np.ndarray) -> np.ndarray:
        """Display values float32 [H, W, 3] as the processor gives them out."""
        toned = Tone(self.contrast).shown(torch.from_numpy(color)).numpy()
        luma = toned @ LUMA
        detail = luma - self._soft(luma)
        return np.clip(toned + np.float32(self.sharpening) * detail[..., None], 0, 1)

    def unsharpened(self, color: np.ndarray) -> np.ndarray:
        """A photo uint8 [H, W, 3] as it was before its luminance was sharpened, the curve left on; black and
        white stay, since what is clipped does not tell from where.

        Luminance Y is the fixed point of Y = (Y'' + sharpening·G ∗ Y) / (1 + sharpening), and of what it is
        off a pass leaves sharpening / (1 + sharpening).
        """
        share = self.sharpening / (1 + self.sharpening)
        sharp = color @ LUMA
        luma = sharp
        for _ in range(math.ceil(math.log(CLOSE) / math.log(max(share, CLOSE)))):
            luma = (1 - share) * sharp + share * self._soft(luma)
        restored = np.clip(color + (luma - sharp)[..., None] + 0.5, 0, 255).astype(np.uint8)
        brightest = color.max(axis=2, keepdims=True)
        return np.where((brightest > 0) & (brightest < 255), restored, color)

    def _soft(self, luma: np.ndarray) -> np.ndarray:
        """G ∗ Y of luminance float32 [H, W]."""
        return cv2.GaussianBlur(luma, (0, 0), self.radius, borderType=cv2.BORDER_REFLECT)

    @classmethod
    def evidence(cls, sequence: Sequence, frames: Indices[int] | None = None) -> tuple[Processor | None, str]:
        """Sharpening where the edge of the lens circle overshoots, in ``frames`` or all that are used; a tone
        curve is for a fit to tell."""
        found = rim.unsharp(sequence, frames)
        if found is None:
            return None, (
                "rendered on request: no sharp edge of a lens circle overshoots, and elsewhere photos do not "
                "tell sharpening from crisp tissue"
            )
        told = f"the edge of the lens circle overshoots by {found.overshoot:.0%}"
        return cls(contrast=0.0, sharpening=found.amount, radius=found.radius_px), told

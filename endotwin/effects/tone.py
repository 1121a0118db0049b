"""Tone curve: a video processor steepens the middle of the display values and flattens both ends."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from endotwin.effects.effect import Effect, parameter

RAMP = np.linspace(0.0, 1.0, 4097)


@dataclass(frozen=True)
class Tone(Effect):
    """C' = C + contrast·(3C² − 2C³ − C) of display values C, with its slope at white beyond.

    It rises, and leaves 0, ½ and 1 in their places.
    """

    name: ClassVar[str] = "tone"
    contrast: float = parameter(0.0, 0.0, 0.9)

    def shown(self, color: Tensor) -> Tensor:
        """C' of C ≥ 0, of its shape."""
        return color + self.contrast * bend(color)

    def slope(self, color: Tensor) -> Tensor:
        """dC'/dC at C, of its shape."""
        inside = color.clamp(max=1)
        return 1 + self.contrast * (6 * inside * (1 - inside) - 1)

    def undone(self, color: np.ndarray) -> np.ndarray:
        """C of C' within 0 … 1, of its shape."""
        ramp = self.shown(torch.from_numpy(RAMP)).numpy()
        return np.interp(color, ramp, RAMP).astype(color.dtype)


def bend(color: Tensor) -> Tensor:
    """dC'/d contrast at C, of its shape."""
    inside = color.clamp(max=1)
    return inside * inside * (3 - 2 * inside) - color

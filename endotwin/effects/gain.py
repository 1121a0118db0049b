"""Automatic gain: the camera brightens or darkens whole frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from endotwin.effects.effect import Effect


@dataclass(frozen=True)
class Gain(Effect):
    """Factor on the radiance of each frame.

    Attributes:
        frames: the training frames, ascending. log_gain: ln of each one's gain; their mean is 0.
    """

    name: ClassVar[str] = "gain"
    frames: tuple[int, ...] = ()
    log_gain: tuple[float, ...] = ()

    def of(self, frame: np.ndarray) -> np.ndarray:
        """Gain of training frames [N], float32 [N]."""
        return np.exp(np.asarray(self.log_gain)[np.searchsorted(self.frames, frame)]).astype(np.float32)

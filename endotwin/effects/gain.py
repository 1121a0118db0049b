"""Automatic gain: the camera brightens or darkens whole frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from endotwin.effects.effect import Effect


@dataclass(frozen=True)
class Gain(Effect):
    """Factor on the radiance of each frame.

    A camera's gain follows what it sees, frame after frame: that of a frame which is not held here is
    interpolated between its neighbours by its number, in the logarithm, and is its nearest one's beyond the
    first and the last.

    Attributes:
        frames: those whose gain was measured, ascending. log_gain: ln of each one's gain; their mean is 0.
    """

    name: ClassVar[str] = "gain"
    frames: tuple[int, ...] = ()
    log_gain: tuple[float, ...] = ()

    def __str__(self) -> str:
        if not self.frames:
            return self.name
        return f"{self.name} (×{np.exp(min(self.log_gain)):.2f} to ×{np.exp(max(self.log_gain)):.2f})"

    def of(self, frame: np.ndarray) -> np.ndarray:
        """Gain of frames [N], measured or not, float32 [N]; 1 where none was measured at all."""
        return np.exp(self._log_of(frame)).astype(np.float32)

    def at(self, frames: np.ndarray) -> Gain:
        """The gain of ``frames`` [F], ascending, measured or not."""
        return Gain.centred(frames, self._log_of(frames))

    @classmethod
    def centred(cls, frames: np.ndarray, log_gain: np.ndarray) -> Gain:
        """Gains of ``frames`` [F] whose logarithms [F] are known up to one summand."""
        return cls(tuple(map(int, frames)), tuple(map(float, log_gain - log_gain.mean())))

    def _log_of(self, frame: np.ndarray) -> np.ndarray:
        if not self.frames:
            return np.zeros(len(frame))
        return np.interp(frame, self.frames, self.log_gain)

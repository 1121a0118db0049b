"""Automatic gain: pictures are kept at a target brightness, a little too late."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from endotwin.effects.effect import Effect, parameter
from endotwin.sequence import Sequence

DARKEST = 1e-6
"""Least mean display value; a picture without surface has none."""


@dataclass(frozen=True)
class AutoGain(Effect):
    """A gain g on all light, whose logarithm follows that of the wanted gain with first-order lag.

    A picture of linear radiance x has the mean display value mean((g·x)^γ) = g^γ·mean(x^γ) but for what is
    clipped, so the wanted gain is (target / mean(x^γ))^(1/γ). At the first frame the gain is the wanted one.

    Attributes:
        target: mean display value. lag: time constant, s. range: greatest gain; its inverse is the least.
    """

    name: ClassVar[str] = "auto_gain"
    target: float = parameter(0.4, 0.01, 0.99)
    lag: float = parameter(0.25, 0.0, 10.0)
    range: float = parameter(4.0, 1.0, 100.0)

    def wanted(self, level: float, gamma: float) -> float:
        """The gain that brings a picture of mean display value ``level`` to the target."""
        gain = (self.target / max(level, DARKEST)) ** (1 / gamma)
        return float(np.clip(gain, 1 / self.range, self.range))

    def next(self, gain: float, wanted: float, seconds: float) -> float:
        """The gain so many ``seconds`` later than ``gain``, with another wanted all the while."""
        left = np.exp(-seconds / self.lag) if self.lag > 0 else 0.0
        return float(wanted * (gain / wanted) ** left)

    @classmethod
    def evidence(cls, sequence: Sequence) -> tuple[AutoGain | None, str]:
        """Never by itself: the fit's own gain of every photo is how a sequence shows one."""
        return None, "rendered on request: what gains the photos had is the effect gain's to find"

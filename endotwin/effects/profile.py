"""Light profile beyond cosⁿθ."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from endotwin.effects.effect import Effect, parameter


@dataclass(frozen=True)
class Profile(Effect):
    """The light falls with its angle as e^{−n(1−cosθ)} (EndoMapper, Azagra et al. 2023) instead of cosⁿθ.

    The light's exponent n takes the place of their μ. ``exponential`` is that shape's share of the
    logarithm: at 0 the light falls as cosⁿθ, and between the two as their product.
    """

    name: ClassVar[str] = "profile"
    exponential: float = parameter(1.0, 0.0, 1.0)

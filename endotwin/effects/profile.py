"""Light profile beyond cosⁿθ."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from endotwin.effects.effect import Effect


@dataclass(frozen=True)
class Profile(Effect):
    """The light falls with its angle as e^{−n(1−cosθ)} (EndoMapper, Azagra et al. 2023) instead of cosⁿθ.

    The light's exponent n takes the place of their μ.
    """

    name: ClassVar[str] = "profile"
    kind: ClassVar[str] = "light"

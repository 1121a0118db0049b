"""Film of fluid: mirror images of the light guides, where the photos showed them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from endotwin.effects.effect import Effect, parameter


@dataclass(frozen=True)
class Film(Effect):
    """A sharp GGX lobe about normals of the fluid's own (``light.film``), on the vertices that it wets.

    Attributes:
        amount: factor on its weight everywhere. roughness: of the lobe, one for all.
    """

    name: ClassVar[str] = "film"
    amount: float = parameter(1.0, 0.0, 10.0)
    roughness: float = parameter(0.065, 0.045, 0.3)

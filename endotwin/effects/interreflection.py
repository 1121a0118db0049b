"""Interreflection: in a closed tube tissue lights tissue, and bends how brightness falls with distance and
angle."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from endotwin.effects.effect import Effect, parameter


@dataclass(frozen=True)
class Interreflection(Effect):
    """Diffuse light between patches of the surface (see ``radiosity``), from each frame's own light.

    It adds 2·L0·E·b to a point's radiance (see ``light.forward``), E the indirect irradiance there times
    ``strength``. That is 0 where the photos show none of it.
    """

    name: ClassVar[str] = "interreflection"
    cell_mm: float = parameter(3.0, 1e-3, 1e3)
    strength: float = parameter(1.0, 0.0, 1.0)

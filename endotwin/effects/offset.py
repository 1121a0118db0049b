"""Light offset: one to three guides that end millimetres beside the lens, as those of real endoscopes do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from endotwin.effects.effect import Effect


@dataclass(frozen=True)
class Offset(Effect):
    """Guides at ``guides_mm`` in the camera frame, equally bright, in the plane of the lens (z = 0) or behind
    it.

    Each shines along the optical axis with the light's n and q; together they have its L0.
    """

    name: ClassVar[str] = "offset"
    guides_mm: tuple[tuple[float, float, float], ...] = ()

    def __str__(self) -> str:
        guides = ", ".join(f"({x:.2f}, {y:.2f}, {z:.2f})" for x, y, z in self.guides_mm)
        return f"{self.name} (guides at {guides} mm)"

"""Cast shadows of guides beside the lens."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from endotwin.effects.effect import Effect


@dataclass(frozen=True)
class Shadows(Effect):
    """A point is lit by those guides alone that see it (one more ray a guide and pixel).

    Light at the lens throws none that the lens could see, so the effect needs an offset.
    """

    name: ClassVar[str] = "shadows"

"""The specular lobe: the highlight of wet tissue."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from endotwin.effects.effect import Effect


@dataclass(frozen=True)
class Specular(Effect):
    """The GGX lobe of each vertex's roughness with the surface's f0 (see ``shading.specular``)."""

    name: ClassVar[str] = "specular"

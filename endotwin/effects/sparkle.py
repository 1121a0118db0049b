"""Sparkle: a film that is rough below a pixel shines in points, here in one view and there in the next."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from endotwin.effects.effect import Effect, parameter


@dataclass(frozen=True)
class Sparkle(Effect):
    """Facets of fluid, each of which mirrors the light guides that it faces (``light.sparkle``).

    Together they are a GGX lobe beside those of the tissue, weight·D·F·G/4(n·ωi)(n·ωo) with F = 0.02 of
    water, which ``density`` leaves as bright as it is: fewer facets are brighter ones.

    Attributes:
        weight: share of the light that they mirror, 1 for a whole film. density: facets a mm², where the
            film is; anywhere without a film. dry: share of that density elsewhere. spread: roughness of them
            all. roughness: of a facet's own lobe, which says in how many views it shines. size: standard
            deviation of the spot that the camera makes of one, in image heights.
    """

    name: ClassVar[str] = "sparkle"
    weight: float = parameter(0.05, 0.0, 50.0)
    density: float = parameter(30.0, 1e-3, 1e4)
    dry: float = parameter(0.05, 0.0, 1.0)
    spread: float = parameter(0.6, 0.1, 1.0)
    roughness: float = parameter(0.11, 0.045, 0.5)
    size: float = parameter(0.0015, 0.0, 0.05)

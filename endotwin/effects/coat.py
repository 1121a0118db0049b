"""Wet coat: a thin clear liquid over the tissue with a lobe of its own, sharper than the tissue's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from endotwin.effects.effect import Effect, parameter


@dataclass(frozen=True)
class Coat(Effect):
    """A second lobe, weight·D·F·G/4(n·ωi)(n·ωo) with F = 0.02 of water (Burley 2012, clearcoat).

    D is generalised Trowbridge–Reitz: GGX for a ``tail`` of 2, Burley's own coat, with a far haze, for 1.

    Of the guides' light it adds to the other lobes; what it takes from them (4 % where it is not grazed) is
    left to the fitted base colour. Of what other tissue throws it mirrors more the more it is grazed, and
    lets through the rest: water's share times a weight up to 1, Schlick's of weight·F beyond.
    """

    name: ClassVar[str] = "coat"
    weight: float = parameter(1.0, 0.0, 50.0)
    roughness: float = parameter(0.12, 0.045, 1.0)
    tail: float = parameter(2.0, 1.0, 2.0)

    @property
    def lobe(self) -> tuple[float, float, float]:
        """Weight, roughness and tail."""
        return self.weight, self.roughness, self.tail

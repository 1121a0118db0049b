"""Polyps that were grown on a twin's surface, and which of its triangles are theirs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

MOST_POLYPS = 255
"""Of one twin: their numbers are kept in 8 bits."""


@dataclass(frozen=True)
class Polyp:
    """One polyp.

    Attributes:
        kind: its Paris class. size_mm: greatest diameter across its axis, of the head if it has a stalk,
            and height_mm: above the wall; both as measured on the mesh.
        place_mm: world position of its foot. axis: unit, from there into the lumen.
        triangles: the first of them, and how many there are.
    """

    kind: str
    size_mm: float
    height_mm: float
    place_mm: tuple[float, float, float]
    axis: tuple[float, float, float]
    triangles: tuple[int, int]

    @classmethod
    def from_dict(cls, values: dict) -> Polyp:
        """The polyp that ``asdict`` made ``values`` of."""
        return cls(**{k: tuple(value) if isinstance(value, list) else value for k, value in values.items()})


def numbered(triangles: Iterable[tuple[int, int]], count: int) -> np.ndarray:
    """Uint8 [F], of ``count`` triangles: 0 of the wall, k of the k-th polyp, which has ``triangles[k-1]``."""
    numbers = np.zeros(count, np.uint8)
    for number, (first, of) in enumerate(triangles, 1):
        numbers[first : first + of] = number
    return numbers

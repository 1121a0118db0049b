"""Fluids that lie on a twin's surface, and which of its triangles they cover."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from endotwin.twin.polyps import numbered

MOST_FLUIDS = 255
"""On one twin: their numbers are kept in 8 bits."""

Ranges = tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Fluid:
    """One patch of a fluid.

    Attributes:
        kind: what it is. size_mm: its greatest extent, and thickness_mm: the greatest one, both as measured
            on the mesh. pool: whether it stands level, rather than adheres.
        place_mm: world position of the point that it spread from.
        triangles: runs of them, each the first and how many; several where it also lies on polyps.
    """

    kind: str
    size_mm: float
    thickness_mm: float
    pool: bool
    place_mm: tuple[float, float, float]
    triangles: Ranges

    @classmethod
    def from_dict(cls, values: dict) -> Fluid:
        """The fluid that ``asdict`` made ``values`` of."""
        runs = tuple((int(first), int(count)) for first, count in values["triangles"])
        return cls(**{**values, "place_mm": tuple(values["place_mm"]), "triangles": runs})


def covered(triangles: Iterable[Ranges], count: int) -> np.ndarray:
    """Uint8 [F], of ``count`` triangles: 0 of bare tissue, k of the k-th fluid, which has the runs
    ``triangles[k-1]``."""
    numbers = np.zeros(count, np.uint8)
    for number, runs in enumerate(triangles, 1):
        numbers[numbered(runs, count) > 0] = number
    return numbers

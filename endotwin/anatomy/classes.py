"""The Paris classes of polyps: outlines, and the heights that tell them apart.

The Paris workshop (Gastrointest. Endosc. 2003; 58 (6 suppl): S3-43) parts what protrudes (0-Ip on a stalk,
0-Is on a base as wide as its top) from what is slightly elevated (0-IIa) by 2.5 mm, the height of the closed
jaws of a biopsy forceps. What is level with the wall is 0-IIb; what lies below it is slightly depressed
(0-IIc) down to 1.2 mm in columnar epithelium, and excavated (0-III) beyond. The update of 2005 (Endoscopy 37:
570-578) keeps these classes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

JAWS_MM = 2.5
DEEPEST_MM = 1.2


@dataclass(frozen=True)
class ParisClass:
    """One class.

    Attributes:
        words: for people. heights_mm: least and greatest, beside those as ``ratios`` of the size; below 0
            beneath the wall.
        usual: height as a share of the size, where that lies within.
        outline: control points (distance from the axis, height) of a cubic spline from the top to the wall:
            distances in half sizes; heights in heights from 0 to 1, as ``stalked`` says.
        edge, head: numbers of the control points where the polyp ends, and the part that its size is of.
        stalked: whether it leaves the wall's own curvature below. bumps: how much of the usual ones it has.
    """

    words: str
    heights_mm: tuple[float, float]
    ratios: tuple[float, float]
    usual: float
    outline: tuple[tuple[float, float], ...]
    edge: int
    head: int
    stalked: bool = False
    bumps: float = 1.0

    def radius_mm(self, size_mm: float) -> float:
        """Of the disc of wall that a polyp of ``size_mm`` is grown from."""
        return self.outline[-1][0] * size_mm / 2

    def height_range_mm(self, size_mm: float) -> tuple[float, float]:
        """Least and greatest height of a polyp of ``size_mm``."""
        low, high = (ratio * size_mm for ratio in self.ratios)
        return max(low, self.heights_mm[0]), min(high, self.heights_mm[1])

    def usual_height_mm(self, size_mm: float) -> float:
        """Height of a polyp of ``size_mm`` unless another is asked for."""
        low, high = self.height_range_mm(size_mm)
        margin = 0.04 * (high - low)
        return float(np.clip(self.usual * size_mm, low + margin, high - margin))


CLASSES = {
    "Ip": ParisClass(
        "pedunculated: a head on a stalk",
        (0.0, np.inf),
        (1.1, 2.5),
        1.45,
        (
            *((0.0, 1.0), (0.35, 1.0), (0.85, 0.95), (1.12, 0.76), (0.95, 0.54), (0.55, 0.47)),
            *((0.3, 0.42), (0.3, 0.3), (0.32, 0.15), (0.38, 0.05), (0.6, 0.0), (0.85, 0.0), (1.1, 0.0)),
        ),
        edge=9,
        head=5,
        stalked=True,
    ),
    "Is": ParisClass(
        "sessile: on a base as wide as its top",
        (JAWS_MM, np.inf),
        (0.0, 1.0),
        0.55,
        (
            *((0.0, 1.0), (0.3, 1.0), (0.68, 0.89), (0.95, 0.58), (1.02, 0.22)),
            *((1.07, 0.03), (1.17, 0.0), (1.28, 0.0), (1.4, 0.0)),
        ),
        edge=5,
        head=5,
    ),
    "IIa": ParisClass(
        "slightly elevated, flat",
        (0.0, JAWS_MM),
        (0.0, 0.5),
        0.2,
        (
            *((0.0, 1.0), (0.3, 1.0), (0.65, 0.95), (0.88, 0.75), (0.97, 0.3)),
            *((1.03, 0.04), (1.13, 0.0), (1.24, 0.0), (1.35, 0.0)),
        ),
        edge=5,
        head=5,
    ),
    "IIb": ParisClass(
        "flat: level with the wall",
        (0.0, 0.0),
        (0.0, 0.0),
        0.0,
        (
            *((0.0, 0.0), (0.3, 0.0), (0.65, 0.0), (0.88, 0.0), (1.0, 0.0)),
            *((1.08, 0.0), (1.16, 0.0), (1.24, 0.0)),
        ),
        edge=4,
        head=4,
        bumps=0.0,
    ),
    "IIc": ParisClass(
        "slightly depressed",
        (-DEEPEST_MM, 0.0),
        (-0.2, 0.0),
        -0.08,
        (
            *((0.0, 1.0), (0.25, 1.0), (0.48, 0.93), (0.68, 0.7), (0.86, 0.35)),
            *((1.03, 0.06), (1.15, 0.0), (1.25, 0.0), (1.35, 0.0)),
        ),
        edge=5,
        head=5,
        bumps=0.4,
    ),
}
"""By the name that the workshop gave them, without its ``0-``."""

"""The unit of a scene whose lengths are not those of a colon in millimetres."""

from __future__ import annotations

import math

import numpy as np

from endotwin.surface import Surface

TYPICAL_MM = 24.0
"""An endoscope sees the wall of a colon from about here."""

COLON_MM = (8.0, 68.0)
"""Seen from between these, a scene may be a colon. Tissue varies over millimetres however near the camera is,
so that the fit's lengths stay in millimetres there."""

CATCHING_UP = 2.0
"""Beyond a colon's distances the unit grows so many times faster than they do, until it has caught up."""


def unit_mm(surface: Surface) -> float:
    """The factor by which ``surface`` was seen from farther away than a colon is: 1 for whatever may be one.

    Elsewhere it is the power of two, which scales floating point exactly, next to distance / TYPICAL_MM; just
    beyond a colon's distances one that is nearer to 1, so that it never steps by more than 2.
    """
    nearest_mm = surface.nearest_mm[surface.seen_by > 0]
    low_mm, high_mm = COLON_MM
    from_mm = max(float(np.median(nearest_mm)), 1e-30) if len(nearest_mm) else TYPICAL_MM
    beyond = max(low_mm / from_mm, from_mm / high_mm)
    if beyond <= 1:
        return 1.0
    doublings = math.log2(from_mm / TYPICAL_MM)
    catching_up = CATCHING_UP * math.log2(beyond) + 0.5
    return 2.0 ** math.copysign(round(min(abs(doublings), catching_up)), doublings)

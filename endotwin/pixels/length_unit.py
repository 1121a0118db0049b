"""The unit of a scene whose lengths are not those of a colon in millimetres."""

from __future__ import annotations

import math

import numpy as np

from endotwin.surface import Surface

TYPICAL_MM = 24.0
"""An endoscope sees the wall of a colon from about here: 8 to 68 mm are one unit."""

BASE = 8
"""Units are powers of it. Tissue varies over millimetres however near the camera is, so the fit's lengths
stay in millimetres for whatever may be a colon; and a power of two scales floating point exactly."""


def unit_mm(surface: Surface) -> float:
    """The factor, a power of ``BASE``, by which ``surface`` was seen from farther away than a colon is."""
    nearest_mm = surface.nearest_mm[surface.seen_by > 0]
    if not len(nearest_mm):
        return 1.0
    ratio = float(np.median(nearest_mm)) / TYPICAL_MM
    return float(BASE ** round(math.log(max(ratio, 1e-30), BASE)))

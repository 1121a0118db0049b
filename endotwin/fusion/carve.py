"""Rays decide what is no surface: a triangle that hides what was measured behind it goes."""

from __future__ import annotations

import numpy as np

from endotwin.fusion.agreement import Comparison
from endotwin.fusion.mesh import pieces
from endotwin.surface import Surface

LEAST_PIECE = 40
"""A connected piece of fewer triangles stays only if some pixel measured it."""


class Votes:
    """Pixels for and against each triangle of a surface."""

    def __init__(self, surface: Surface):
        self._surface = surface
        self.at = np.zeros(len(surface.triangles), np.int64)
        self.before = np.zeros(len(surface.triangles), np.int64)

    def add(self, seen: Comparison) -> None:
        """Count the hits of one view."""
        self.at += np.bincount(seen.triangle[seen.at], minlength=len(self.at))
        self.before += np.bincount(seen.triangle[seen.before], minlength=len(self.before))

    def kept(self) -> np.ndarray:
        """Bool [F]: hit where it was measured at least as often as in front of that, and no unmeasured
        crumb."""
        piece = pieces(len(self._surface.vertices_mm), self._surface.triangles)
        crumb = (np.bincount(piece) < LEAST_PIECE) & (np.bincount(piece, self.at) == 0)
        return (self.at >= self.before) & ~crumb[piece]

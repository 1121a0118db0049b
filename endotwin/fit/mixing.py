"""Fixed points that a plain iteration reaches slowly, or swings about."""

from __future__ import annotations

import numpy as np

DEPTH = 3
"""Steps that are remembered."""

RCOND = 1e-6
"""Changes below this share of the largest tell nothing."""


class Mixing:
    """Anderson's acceleration of x ← g(x) (Anderson 1965; Walker and Ni 2011, equation 2.3).

    Of the last points and where the iteration took them it finds the combination whose step is least, as if g
    were linear.
    """

    def __init__(self) -> None:
        self._points: list[np.ndarray] = []
        self._steps: list[np.ndarray] = []

    def mixed(self, point: np.ndarray, image: np.ndarray) -> np.ndarray:
        """Where to go on, [N], from a ``point`` [N] whose ``image`` under g is [N]."""
        step = image - point
        self._points = [*self._points, point][-DEPTH - 1 :]
        self._steps = [*self._steps, step][-DEPTH - 1 :]
        if len(self._points) == 1:
            return image
        moved, turned = (np.diff(each, axis=0).T for each in (self._points, self._steps))
        weights = np.linalg.lstsq(turned, step, rcond=RCOND)[0]
        return image - (moved + turned) @ weights

"""Spreads that outliers hardly widen."""

import numpy as np

NORMAL = 1.4826
"""Standard deviation of a normal distribution by the median size of what is drawn from it (Hampel 1974)."""


def robust_std(residual: np.ndarray, least: float = 0.0) -> float:
    """Standard deviation about zero of ``residual``, of any shape, as if it were normal but for outliers; not
    below ``least``, which it is if there are no residuals."""
    return max(NORMAL * float(np.median(np.abs(residual))), least) if residual.size else least

"""Some of many frames, where a look at all of them would take long."""

import numpy as np


def spread(count: int, most: int) -> np.ndarray:
    """At most ``most`` of the numbers below ``count``, evenly spread from the first to the last, int [N]."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))

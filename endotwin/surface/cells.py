"""Points merged by the cells of a grid."""

from __future__ import annotations

import numpy as np


def merged(points_mm: np.ndarray, cell_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Points [N, 3] merged by cells of edge ``cell_mm``: mean points float64 [P, 3], and the one of each
    point, int [N]."""
    cells = np.floor(points_mm / cell_mm).astype(np.int64)
    _, group, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    group = group.reshape(-1)
    sums = [np.bincount(group, points_mm[:, axis]) for axis in range(3)]
    return np.stack(sums, axis=1) / count[:, None], group

"""Points merged by the cells of a grid."""

from __future__ import annotations

import numpy as np


def merged(points_mm: np.ndarray, cell_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Points [N, 3] merged by cells of edge ``cell_mm``: mean points float64 [P, 3], and the one of each
    point, int [N]."""
    group = numbered(np.floor(points_mm / cell_mm).astype(np.int64))
    count = np.bincount(group)
    sums = [np.bincount(group, points_mm[:, axis]) for axis in range(3)]
    return np.stack(sums, axis=1) / count[:, None], group


def numbered(cells: np.ndarray) -> np.ndarray:
    """Cells int [N, K] by number, in the order of their coordinates and without gaps, int [N]."""
    number = np.zeros(len(cells), np.int64)
    for along in cells.T:
        found, place = np.unique(along, return_inverse=True)
        number = np.unique(number * len(found) + place, return_inverse=True)[1]
    return number

"""Vertices and those that an edge joins them to."""

from __future__ import annotations

import numpy as np
import scipy.sparse


def neighbour_mean(count: int, triangles: np.ndarray) -> scipy.sparse.csr_array:
    """Operator [V, V] that replaces each vertex's value by the mean over its neighbours in ``triangles``."""
    start, end = triangles[:, [0, 1, 1, 2, 2, 0]].ravel(), triangles[:, [1, 0, 2, 1, 0, 2]].ravel()
    joined = scipy.sparse.csr_array((np.ones(len(start), np.float32), (start, end)), shape=(count, count))
    joined.data[:] = 1
    degree = np.maximum(joined.sum(axis=1), 1)
    return scipy.sparse.csr_array(scipy.sparse.diags_array(1 / degree) @ joined)

"""Products and lengths of many vectors at once."""

from __future__ import annotations

import numpy as np


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Products a·b, [...], of vectors [..., 3]; by columns, since sums over rows of three are slow."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors [..., 3] scaled to unit length; a zero vector stays zero."""
    norm = np.sqrt(dot(vectors, vectors))[..., None]
    return vectors / np.maximum(norm, np.finfo(vectors.dtype).tiny)


def turned_along(vectors: np.ndarray, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Vectors [N, 3] turned as unit vectors ``one`` [N, 3] turn the least way to ``other`` [N, 3], which they
    are not opposite to (Rodrigues)."""
    axis = np.cross(one, other)
    across = np.cross(axis, vectors)
    return vectors + across + np.cross(axis, across) / (1 + dot(one, other))[:, None]

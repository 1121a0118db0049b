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

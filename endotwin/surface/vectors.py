"""Sums, products and lengths of many vectors at once: by columns, since rows of three are slow."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Products a·b, [...], of vectors [..., 3]."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def shifted(vectors: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Vectors [..., 3] and ``by`` [3] together, of the vectors' precision, but added in the higher one."""
    return _by_columns(np.add, vectors, by)


def scaled(vectors: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """Vectors [..., 3], each times its ``factor`` [...]."""
    return _by_columns(np.multiply, vectors, (factor,) * 3)


def _by_columns(operation: np.ufunc, vectors: np.ndarray, others: Sequence) -> np.ndarray:
    found = np.empty_like(vectors)
    for k in range(3):
        operation(vectors[..., k], others[k], out=found[..., k], casting="same_kind")
    return found


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors [..., 3] scaled to unit length; a zero vector stays zero."""
    norm = np.maximum(np.sqrt(dot(vectors, vectors)), np.finfo(vectors.dtype).tiny)
    return _by_columns(np.divide, vectors, (norm,) * 3)


def frame_along(axis: np.ndarray) -> np.ndarray:
    """Rows [..., 3, 3] of right-handed frames with the third along unit vectors ``axis`` [..., 3]."""
    side = unit(np.cross(axis, np.eye(3, dtype=axis.dtype)[np.abs(axis).argmin(axis=-1)]))
    return np.stack([side, np.cross(axis, side), axis], axis=-2)


def turned_along(vectors: np.ndarray, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Vectors [N, 3] turned as unit vectors ``one`` [N, 3] turn the least way to ``other`` [N, 3], which they
    are not opposite to (Rodrigues)."""
    axis = np.cross(one, other)
    across = np.cross(axis, vectors)
    return vectors + across + np.cross(axis, across) / (1 + dot(one, other))[:, None]

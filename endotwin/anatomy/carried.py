"""What vertices that are set between others have of theirs."""

from __future__ import annotations

import numpy as np
import scipy.sparse

from endotwin.light.film import Film
from endotwin.surface import Surface
from endotwin.surface.vectors import unit


def kept(before: np.ndarray, after: np.ndarray, changed: np.ndarray) -> np.ndarray:
    """``after`` as float32, the rows of ``before`` bit for bit where they are not ``changed``."""
    result = after.astype(before.dtype)
    same = np.ones(len(before), bool)
    same[changed[changed < len(before)]] = False
    result[: len(before)][same] = before[same]
    return result


def coverage(surface: Surface, weights: scipy.sparse.csr_array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``seen_by``, ``nearest_mm`` and ``filled`` of vertices that lie between others: the worst of theirs."""
    count = len(surface.vertices_mm)
    rows, added = weights[count:], [surface.seen_by, surface.nearest_mm, surface.filled]
    if not rows.shape[0]:
        return tuple(added)
    starts, parents = rows.indptr[:-1], rows.indices
    for k, worst in enumerate((np.minimum, np.maximum, np.logical_or)):
        added[k] = np.concatenate([added[k], worst.reduceat(added[k][parents], starts)])
    return tuple(added)


def carried_film(film: Film, weights: scipy.sparse.csr_array, moved: np.ndarray, turn: np.ndarray) -> Film:
    """The film on the new vertices too; its normals turn with those of the tissue, by ``turn`` [N, 3]."""
    count = weights.shape[1]
    weight = weights @ film.on_all(film.weight, count).astype(np.float64)
    normal = weights @ film.on_all(film.normal, count).astype(np.float64)
    normal[moved] += turn
    vertex = np.flatnonzero(weight > 0)
    return Film(
        vertex.astype(np.int32),
        unit(normal[vertex]).astype(np.float32),
        weight[vertex].astype(np.float32),
    )

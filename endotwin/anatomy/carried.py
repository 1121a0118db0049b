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


def coverage(surface: Surface, weights: scipy.sparse.csr_array) -> dict[str, np.ndarray]:
    """``seen_by``, ``nearest_mm`` and ``filled`` of vertices that lie between others: the worst of theirs."""
    rows = weights[len(surface.vertices_mm) :]
    worst = {"seen_by": np.minimum, "nearest_mm": np.maximum, "filled": np.logical_or}
    values = {name: getattr(surface, name) for name in worst}
    if not rows.shape[0]:
        return values
    starts, parents = rows.indptr[:-1], rows.indices
    return {
        name: np.concatenate([old, worst[name].reduceat(old[parents], starts)])
        for name, old in values.items()
    }


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

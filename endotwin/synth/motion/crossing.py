"""Triangles of a surface that cross each other: edges that pass through a triangle they do not touch."""

from __future__ import annotations

import numpy as np

from endotwin.surface import Surface
from endotwin.surface.casting import Caster
from endotwin.surface.vectors import unit

ENDS = 1e-3
"""Share of an edge at its ends that is not judged: there it meets its own triangles."""


def crossings(surface: Surface) -> np.ndarray:
    """Numbers, ascending, of triangles that an edge of another passes through, int [K]."""
    one, other = surface.triangles[:, [0, 1, 2]].ravel(), surface.triangles[:, [1, 2, 0]].ravel()
    vertices = np.int64(len(surface.vertices_mm))
    pairs = np.sort(np.minimum(one, other) * vertices + np.maximum(one, other))
    edges = np.stack(np.divmod(pairs[np.diff(pairs, prepend=-1) > 0], vertices), axis=1)
    start, end = (surface.vertices_mm[edges[:, k]] for k in range(2))
    towards = end - start
    length_mm = np.linalg.norm(towards, axis=1)
    long = length_mm > 0
    edges, start, towards, length_mm = edges[long], start[long], towards[long], length_mm[long]
    caster, origins, directions = Caster(surface), start + ENDS * towards, unit(towards)
    reach_mm = (1 - 2 * ENDS) * length_mm
    met = np.flatnonzero(~caster.unobstructed(origins, directions, reach_mm))  # which few are, is soon told
    hit, _, distance_mm = caster.cast_rays(origins[met], directions[met])
    within = distance_mm < reach_mm[met]
    hit, met = hit[within], met[within]
    touching = (surface.triangles[hit][:, :, None] == edges[met][:, None, :]).any(axis=(1, 2))
    return np.unique(hit[~touching])

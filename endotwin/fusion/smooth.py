"""Noise of depth crumples a mesh, and a crumpled mesh has normals that no light can be judged by."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.sparse
import trimesh

from endotwin.fusion.mesh import vertex_normals
from endotwin.incidence import unit
from endotwin.surface import Surface

CRUMPLED_DEG = 3.0
"""Corner normals of a triangle that differ by more, in the median, come from noise: clean depth gives 1°."""

TAUBIN_STEPS, TAUBIN_ROUNDS = 20, 3
TAUBIN_SHRINK, TAUBIN_GROW = 0.5, 0.53
"""Taubin 1995: a smoothing step and a slightly larger step back keep the volume."""

NORMAL_ROUNDS = 4


def crumple_deg(surface: Surface) -> float:
    """Median, over the triangles, of the largest angle between two corners' normals."""
    return float(np.degrees(np.arccos(np.clip(np.median(surface.normal_agreement()), -1, 1))))


def smoothed(surface: Surface) -> Surface:
    """``surface`` as smooth as clean depth would have made it; one that is not crumpled is returned as it is.

    Rounds of Taubin's smoothing move the vertices, then rounds of averaging turn the normals, until the
    surface is no longer crumpled or the rounds are used up.
    """
    if crumple_deg(surface) <= CRUMPLED_DEG:
        return surface
    neighbours = _neighbour_mean(len(surface.vertices_mm), surface.triangles)
    mesh = trimesh.Trimesh(surface.vertices_mm, surface.triangles, process=False)
    for _ in range(TAUBIN_ROUNDS):
        trimesh.smoothing.filter_taubin(mesh, TAUBIN_SHRINK, TAUBIN_GROW, TAUBIN_STEPS, neighbours)
        vertices_mm = np.asarray(mesh.vertices, np.float32)
        surface = replace(
            surface, vertices_mm=vertices_mm, normals=vertex_normals(vertices_mm, surface.triangles)
        )
        if crumple_deg(surface) <= CRUMPLED_DEG:
            return surface
    for _ in range(NORMAL_ROUNDS):
        surface = replace(surface, normals=unit((neighbours @ surface.normals).astype(np.float32)))
        if crumple_deg(surface) <= CRUMPLED_DEG:
            break
    return surface


def _neighbour_mean(count: int, triangles: np.ndarray) -> scipy.sparse.csr_array:
    """Operator [V, V] that replaces each vertex's value by the mean over its neighbours."""
    start, end = triangles[:, [0, 1, 1, 2, 2, 0]].ravel(), triangles[:, [1, 0, 2, 1, 0, 2]].ravel()
    joined = scipy.sparse.csr_array((np.ones(len(start), np.float32), (start, end)), shape=(count, count))
    joined.data[:] = 1
    degree = np.maximum(joined.sum(axis=1), 1)
    return scipy.sparse.csr_array(scipy.sparse.diags_array(1 / degree) @ joined)

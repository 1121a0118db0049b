"""Noise of depth crumples a mesh, and a crumpled mesh has normals that no light can be judged by."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from endotwin.fusion.mesh import surface_of
from endotwin.surface import Surface
from endotwin.surface.neighbours import neighbour_mean
from endotwin.surface.vectors import unit

CRUMPLED_DEG = 1.5
"""Angle between a vertex's normal and its neighbours' mean, in the median, that only noise gives: clean depth
leaves 0.2° to 1.2°, 1 % of noise 18°."""

TAUBIN_STEPS, TAUBIN_ROUNDS = 20, 3
TAUBIN_SHRINK, TAUBIN_GROW = 0.5, 0.53
"""Taubin 1995: a smoothing step and a slightly larger step back keep the volume."""

NORMAL_ROUNDS = 4


def smoothed(surface: Surface) -> Surface:
    """``surface`` as smooth as clean depth would have made it; one that is not crumpled is returned as it is.

    Rounds of Taubin's smoothing move the vertices, then rounds of averaging turn the normals, until the
    surface is no longer crumpled or the rounds are used up. Crumbs that shrink to nothing are dropped.
    """
    if crumple_deg(surface) <= CRUMPLED_DEG:
        return surface
    import trimesh  # which takes most of a second, and clean depth does without

    mesh = trimesh.Trimesh(surface.vertices_mm, surface.triangles, process=False)
    neighbours = neighbour_mean(len(surface.vertices_mm), surface.triangles)
    filled = surface.filled
    for _ in range(TAUBIN_ROUNDS):
        trimesh.smoothing.filter_taubin(mesh, TAUBIN_SHRINK, TAUBIN_GROW, TAUBIN_STEPS, neighbours)
        vertices_mm = np.asarray(mesh.vertices, np.float32)
        surface = surface_of(surface.origin_mm, vertices_mm, mesh.faces, filled)
        if crumple_deg(surface) <= CRUMPLED_DEG:
            return surface
    for _ in range(NORMAL_ROUNDS):
        surface = replace(surface, normals=_neighbours_normals(surface))
        if crumple_deg(surface) <= CRUMPLED_DEG:
            break
    return surface


def crumple_deg(surface: Surface) -> float:
    """Median, over the vertices, of the angle between a normal and the mean of its neighbours' normals.

    Curvature turns normals to either side alike, and so leaves it small; noise does not.
    """
    cosine = np.einsum("va,va->v", surface.normals, _neighbours_normals(surface))
    return float(np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1))))


def _neighbours_normals(surface: Surface) -> np.ndarray:
    """The direction of the mean of each vertex's neighbours' normals, float32 [V, 3]; the vertex's own where
    they cancel."""
    mean = (neighbour_mean(len(surface.vertices_mm), surface.triangles) @ surface.normals).astype(np.float32)
    return np.where(mean.any(axis=1, keepdims=True), unit(mean), surface.normals)

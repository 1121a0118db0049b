"""Small holes that no depth map saw are closed from the surface around them, unless a ray passed through."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import scipy.sparse
from scipy.sparse.linalg import spsolve

from endotwin.cameras import Camera
from endotwin.fusion.agreement import Tolerance, against
from endotwin.fusion.mesh import boundary_edges, surface_of
from endotwin.fusion.views import View
from endotwin.run.ahead import ahead
from endotwin.run.threads import THREADS
from endotwin.surface import Surface
from endotwin.surface.neighbours import neighbour_mean

LONGEST_RIM_VOXELS = 30.0
"""A hole with a longer rim stays open: about 10 voxels across, it is no gap in the sampling."""

MOST_RINGS = 5


@dataclass(frozen=True)
class _Caps:
    """Vertices [N, 3] and triangles [M, 3] that close holes, numbered on from the surface's vertices, and the
    hole of each vertex [N] and triangle [M]."""

    vertices_mm: np.ndarray
    triangles: np.ndarray
    hole: np.ndarray
    triangle_hole: np.ndarray


def filled(
    camera: Camera, surface: Surface, views: Iterable[View], tolerance: Tolerance, voxel_mm: float
) -> Surface:
    """``surface`` with its small holes closed and their new vertices marked ``filled``.

    A cap continues the bend of the surface around it: its vertices minimise the thin-plate energy (Botsch &
    Kobbelt 2004). Caps that hide what some view measured behind them more often than they lie at it are left
    out.
    """
    rims = _rims(surface, LONGEST_RIM_VOXELS * voxel_mm)
    if not rims:
        return surface
    caps = _caps(surface, rims)
    first = len(surface.vertices_mm)
    vertices_mm = np.concatenate([surface.vertices_mm, caps.vertices_mm])
    triangles = np.concatenate([surface.triangles, caps.triangles])
    vertices_mm[first:] = _faired(vertices_mm, triangles, first)
    sound = _unpierced(camera, surface, vertices_mm[first:], caps.hole, views, tolerance)
    sound &= _upright(surface, rims, vertices_mm, caps)
    triangles = np.concatenate([surface.triangles, caps.triangles[sound[caps.triangle_hole]]])
    return surface_of(surface.origin_mm, vertices_mm, triangles, np.arange(len(vertices_mm)) >= first)


def _rims(surface: Surface, longest_mm: float) -> list[np.ndarray]:
    """Vertices around each hole with a rim of at most ``longest_mm``, in the direction of its triangles.

    The outline of a loose piece is left out: closed, it would be a bubble.
    """
    loops = [loop for loop in _loops(boundary_edges(surface.triangles)) if len(loop) > 2]
    if not loops:
        return []
    size = np.array([len(loop) for loop in loops])
    first = np.cumsum(size) - size
    points_mm = surface.vertices_mm[np.concatenate(loops)]
    following = np.arange(1, len(points_mm) + 1)
    following[first + size - 1] = first
    next_mm, start_mm = points_mm[following], np.repeat(points_mm[first], size, axis=0)
    length_mm = np.add.reduceat(np.linalg.norm(next_mm - points_mm, axis=1), first)
    spanned = np.add.reduceat(np.cross(next_mm - start_mm, points_mm - start_mm), first)
    facing = np.add.reduceat(surface.normals[np.concatenate(loops)], first)
    holes = (length_mm <= longest_mm) & (np.einsum("la,la->l", spanned, facing) > 0)
    return [loops[index] for index in np.flatnonzero(holes)]


def _loops(edges: np.ndarray) -> Iterator[np.ndarray]:
    """Loops [N] of vertices that directed ``edges`` [E, 2] form. Those that touch are cut there, so that none
    passes a vertex twice; edges that lead nowhere are left out."""
    following: dict[int, list[int]] = {}
    for start, end in edges.tolist():
        following.setdefault(start, []).append(end)
    while following:
        path = [next(iter(following))]
        place = {path[0]: 0}
        while path:
            ways = following.get(path[-1])
            if ways is None:
                del place[path.pop()]
                continue
            vertex = ways.pop()
            if not ways:
                del following[path[-1]]
            if vertex in place:
                loop = path[place[vertex] :]
                yield np.array(loop)
                for passed in loop[1:]:
                    del place[passed]
                del path[place[vertex] + 1 :]
            else:
                place[vertex] = len(path)
                path.append(vertex)


def _caps(surface: Surface, rims: list[np.ndarray]) -> _Caps:
    """Each rim closed by rings about as far apart as its vertices, and a fan about their mean."""
    points, triangles, hole, triangle_hole = [], [], [], []
    number = len(surface.vertices_mm)
    for index, rim in enumerate(rims):
        size = len(rim)
        rings = int(np.clip(round(size / (2 * np.pi)), 1, MOST_RINGS))
        rim_mm = surface.vertices_mm[rim]
        share = (np.arange(1, rings) / rings)[:, None, None]
        inner = (rim_mm + share * (rim_mm.mean(axis=0) - rim_mm)).reshape(-1, 3)
        points += [inner, rim_mm.mean(axis=0, keepdims=True)]
        circles = np.vstack([rim, number + np.arange(len(inner)).reshape(-1, size)])
        centre = number + len(inner)
        here, beside = circles, np.roll(circles, -1, axis=1)
        band = [
            np.stack([beside[:-1], here[:-1], here[1:]], axis=-1),
            np.stack([beside[:-1], here[1:], beside[1:]], axis=-1),
            np.stack([beside[-1:], here[-1:], np.full((1, size), centre)], axis=-1),
        ]
        band = np.concatenate([part.reshape(-1, 3) for part in band])
        triangles.append(band)
        triangle_hole.append(np.full(len(band), index))
        hole.append(np.full(len(inner) + 1, index))
        number = centre + 1
    return _Caps(
        np.concatenate(points).astype(np.float32),
        np.concatenate(triangles).astype(np.int32),
        np.concatenate(hole),
        np.concatenate(triangle_hole),
    )


def _faired(vertices_mm: np.ndarray, triangles: np.ndarray, first: int) -> np.ndarray:
    """Vertices from number ``first`` on, moved to where |Δx|² is least over them and their neighbours."""
    laplacian = scipy.sparse.identity(len(vertices_mm), format="csr") - neighbour_mean(
        len(vertices_mm), triangles
    )
    near = np.unique(triangles[(triangles >= first).any(axis=1)])
    laplacian = laplacian[near]
    free = laplacian[:, first:]
    right = -free.T @ (laplacian[:, :first] @ vertices_mm[:first].astype(np.float64))
    return spsolve((free.T @ free).tocsc(), right).reshape(-1, 3)


def _upright(surface: Surface, rims: list[np.ndarray], vertices_mm: np.ndarray, caps: _Caps) -> np.ndarray:
    """Bool [holes]: caps no triangle of which faces away from where the surface around it does."""
    facing = np.stack([surface.normals[rim].sum(axis=0) for rim in rims])
    corners = vertices_mm[caps.triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    turned = np.einsum("ta,ta->t", normal, facing[caps.triangle_hole]) <= 0
    return np.bincount(caps.triangle_hole, turned, len(rims)) == 0


def _unpierced(
    camera: Camera,
    surface: Surface,
    points_mm: np.ndarray,
    hole: np.ndarray,
    views: Iterable[View],
    tolerance: Tolerance,
) -> np.ndarray:
    """Bool [holes]: no more often in front of what was measured than at it, of local ``points_mm`` [N, 3]."""

    def votes(view: View) -> np.ndarray:
        inside, before, at = against(camera, surface, points_mm, view, tolerance)
        return np.bincount(hole[inside], at.astype(int) - before.astype(int), hole[-1] + 1)

    return sum(ahead(votes, views, threads=THREADS)) >= 0

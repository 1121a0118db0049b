"""What every stage of fusion asks of a triangle mesh: normals, and removing what is no surface."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from endotwin.surface import Surface


def surface_of(
    origin_mm: np.ndarray, vertices_mm: np.ndarray, triangles: np.ndarray, filled: np.ndarray | None = None
) -> Surface:
    """An unseen surface about ``origin_mm`` from local vertices [V, 3], of which some are ``filled`` [V].

    Triangles that lie on one another are dropped, so are those about a vertex that has no normal, and
    vertices that no triangle uses.
    """
    triangles = _unfolded(triangles)
    normals = vertex_normals(vertices_mm, triangles)
    while (flat := ~normals.any(axis=1)[triangles].all(axis=1)).any():
        triangles = triangles[~flat]
        normals = vertex_normals(vertices_mm, triangles)
    is_used = np.zeros(len(vertices_mm), bool)
    is_used[triangles] = True
    used = np.flatnonzero(is_used)
    triangles = (np.cumsum(is_used) - 1)[triangles]
    count = len(used)
    return Surface(
        origin_mm=np.asarray(origin_mm, np.float64),
        vertices_mm=np.ascontiguousarray(vertices_mm[used], np.float32),
        triangles=triangles.astype(np.int32),
        normals=normals[used],
        seen_by=np.zeros(count, np.int32),
        nearest_mm=np.full(count, np.inf, np.float32),
        filled=np.zeros(count, bool) if filled is None else filled[used],
    )


def _unfolded(triangles: np.ndarray) -> np.ndarray:
    """``triangles`` [F, 3] with one of each set of equal ones, and none where two face opposite ways."""
    ordered = np.sort(triangles, axis=1).astype(np.int64)
    count = int(triangles.max(initial=0)) + 1
    _, first, same = np.unique(
        (ordered[:, 0] * count + ordered[:, 1]) * count + ordered[:, 2],
        return_index=True,
        return_inverse=True,
    )
    start = triangles.argmin(axis=1)
    rising = np.take_along_axis(triangles, ((start + 1) % 3)[:, None], axis=1)[:, 0] == ordered[:, 1]
    facing = np.bincount(same, np.where(rising, 1, -1))
    keep = np.zeros(len(triangles), bool)
    keep[first[facing != 0]] = True
    return triangles[keep]


def vertex_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Area-weighted unit normals, float32 [V, 3], of vertices [V, 3] and triangles [F, 3]; zero where there
    is none."""
    edges = vertices[triangles[:, 1:]] - vertices[triangles[:, :1]]
    area = np.cross(edges[:, 0], edges[:, 1]).astype(np.float64)
    total = np.zeros((len(vertices), 3))
    for corner in triangles.T:
        for axis in range(3):
            total[:, axis] += np.bincount(corner, area[:, axis], len(vertices))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return (total / np.where(length > 0, length, 1)).astype(np.float32)


def proper(triangles: np.ndarray) -> np.ndarray:
    """Bool [F]: triangles [F, 3] whose three vertices differ."""
    a, b, c = triangles.T
    return (a != b) & (b != c) & (c != a)


def single(triangles: np.ndarray) -> np.ndarray:
    """``triangles`` [F, 3] without those that lie on the same side of an edge as an earlier one."""
    start, end = triangles.astype(np.int64), np.roll(triangles, -1, axis=1)
    edge = (start * (int(triangles.max(initial=0)) + 1) + end).ravel()
    order = np.argsort(edge, kind="stable")
    again = np.zeros(len(edge), bool)
    again[order[1:]] = edge[order[1:]] == edge[order[:-1]]
    return triangles[~again.reshape(-1, 3).any(axis=1)]


def boundary_edges(triangles: np.ndarray) -> np.ndarray:
    """Directed edges [B, 2] of triangles [F, 3] that no neighbour has the other way round."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]).astype(
        np.int64
    )
    low, high = edges.min(axis=1), edges.max(axis=1)
    there = 2 * (low * (int(triangles.max(initial=0)) + 1) + high) + (edges[:, 0] > edges[:, 1])
    ascending = np.sort(there)
    once = ascending[np.diff(ascending, prepend=-1) > 0]
    first = np.flatnonzero(once[1:] == once[:-1] ^ 1)  # of the two directions of an edge
    lonely = np.delete(once, np.r_[first, first + 1])
    found = np.r_[lonely, -1][np.searchsorted(lonely, there)]
    return edges[(found == there) & (low != high)]


def pieces(vertex_count: int, triangles: np.ndarray) -> np.ndarray:
    """The connected piece, int [F], that each of ``triangles`` [F, 3] belongs to."""
    return joined(vertex_count, np.concatenate([triangles[:, :2], triangles[:, 1:]]))[triangles[:, 0]]


def without_short_edges(
    vertices_mm: np.ndarray, triangles: np.ndarray, shortest_mm: float
) -> tuple[np.ndarray, np.ndarray]:
    """The mesh with vertices that an edge shorter than ``shortest_mm`` joins made one, at their mean.

    Of its border, edges count whose one triangle names the lower number first; with all of them, or none,
    twins came out up to 0.1 dB worse and 0.05 dB better.
    """
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    edges = edges[edges[:, 0] < edges[:, 1]]
    short = np.linalg.norm(vertices_mm[edges[:, 0]] - vertices_mm[edges[:, 1]], axis=1) < shortest_mm
    number = joined(len(vertices_mm), edges[short])
    count = np.bincount(number)
    mean_mm = np.stack([np.bincount(number, axis) / count for axis in vertices_mm.T], axis=1).astype(
        np.float32
    )
    triangles = number[triangles].astype(np.int32)
    return mean_mm, triangles[proper(triangles)]


def joined(count: int, edges: np.ndarray) -> np.ndarray:
    """Number of the connected component, in order of first appearance, of ``count`` vertices under
    ``edges`` [E, 2]."""
    graph = coo_array((np.ones(len(edges), bool), edges.T), shape=(count, count))
    return connected_components(graph, directed=False)[1]

"""How fluid spreads over a part of a mesh: as a film with ragged edges, as lumps, or as a level pool."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from heapq import heapify, heappop, heappush

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components, dijkstra

from endotwin.anatomy.shape import smoothstep

WAVES = 24
LONGEST = 0.9
"""Greatest wavelength of what makes a film uneven, in sizes."""

RAGGEDNESS = 0.06
"""Least wavelength of its edge, as a share of that."""

RUN = 2.0
"""How many times longer its pattern is along the way it ran."""

RAGGED = 0.55
"""Swing of a film's edge, as a share of its reach."""


def edges_of(points: np.ndarray, triangles: np.ndarray) -> scipy.sparse.csr_array:
    """The graph of edges, with their lengths, of triangles [F, 3] of points [P, 3]."""
    ends = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    one, other = np.unique(ends, axis=0).T
    length = np.maximum(np.linalg.norm(points[one] - points[other], axis=1), 1e-9)
    return scipy.sparse.coo_array((length, (one, other)), shape=(len(points),) * 2).tocsr()


def along_mesh(graph: scipy.sparse.csr_array, start: int, limit_mm: float) -> np.ndarray:
    """Length of the shortest way [P] along edges from a point; inf beyond the limit."""
    return dijkstra(graph, directed=False, indices=start, limit=limit_mm)


def noise(
    longest_mm: float, finest: float, run: np.ndarray, generator: np.random.Generator
) -> Callable[[np.ndarray], np.ndarray]:
    """A pattern of points [P, 3], of mean 0 and standard deviation 1, drawn by chance: plane waves of up to
    ``longest_mm``, and down to the share ``finest`` of that, whose amplitudes are as the square root of their
    lengths, stretched along the unit vector ``run`` [3]."""
    directions = generator.standard_normal((WAVES, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions -= (1 - 1 / RUN) * (directions @ run)[:, None] * run
    lengths_mm = longest_mm * np.geomspace(finest, 1, WAVES)
    offsets = generator.uniform(0, 2 * np.pi, WAVES)
    amplitudes = np.sqrt(2 * lengths_mm / lengths_mm.sum())
    waves = 2 * np.pi * directions / lengths_mm[:, None]
    return lambda points: np.cos(points @ waves.T + offsets) @ amplitudes


def within(far_mm: np.ndarray, size_mm: float, pattern: np.ndarray) -> np.ndarray:
    """How far inside a film of ``size_mm`` points [P] are, 1 about its middle, at most 0 outside, whose edge
    swings with a ``pattern`` [P]; nothing of it is farther than half its size along the mesh."""
    reach = 1 - 2 * np.minimum(far_mm / size_mm, 1)
    return np.minimum(1.5 * reach - RAGGED / 2 + RAGGED * pattern, 4 * reach)


@dataclass(frozen=True)
class Spread:
    """How something adheres: the share of its thickness that it has, by how far inside points are and a
    pattern, [P] each; and the least wavelength of that pattern, as a share of the longest."""

    share: Callable[[np.ndarray, np.ndarray], np.ndarray]
    finest: float


def film(inside: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """Share of its thickness [P] that a film has: thin towards its edge, and uneven."""
    return smoothstep(inside / 0.7) ** 2 * (0.06 + 0.94 * smoothstep(0.5 + 0.3 * pattern))


def strands(inside: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """As ``film``, of what is viscous and draws threads: ridges where the pattern crosses 0."""
    return smoothstep(inside / 0.45) * (0.3 + 0.7 * np.exp(-((pattern / 0.45) ** 2)))


def lumps(inside: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """As ``film``, of what holds its shape: domes with bumps."""
    return smoothstep(inside / 1.2) ** 0.7 * (0.4 + 0.6 * smoothstep(0.5 + 0.3 * pattern))


SPREADS = {"film": Spread(film, 0.06), "strands": Spread(strands, 0.06), "lumps": Spread(lumps, 0.3)}
"""By name."""


def pool_mm(
    height_mm: np.ndarray, inside: np.ndarray, graph: scipy.sparse.csr_array, deepest_mm: float
) -> np.ndarray:
    """Depth [P] of the fluid that stands in the hollow, of those among the points ``inside``, bool [P], which
    holds most; over other points it runs off.

    Args:
        height_mm: [P]. graph: of the edges between the points. deepest_mm: greatest depth.
    """
    depth_mm = spill_mm(height_mm, inside, graph) - height_mm
    full = np.flatnonzero(depth_mm > 0)
    if not len(full):
        return depth_mm
    _, part = connected_components(graph[full][:, full], directed=False)
    held = full[part == np.bincount(part, np.minimum(depth_mm[full], deepest_mm)).argmax()]
    result = np.zeros(len(height_mm))
    result[held] = np.maximum(depth_mm[held] - max(depth_mm[held].max() - deepest_mm, 0), 0)
    return result


def spill_mm(height_mm: np.ndarray, inside: np.ndarray, graph: scipy.sparse.csr_array) -> np.ndarray:
    """Level [P] at which fluid over each point runs off: the priority flood of Barnes, Lehman and Mulla
    (Computers & Geosciences 2014; 62: 117, algorithm 1), from the points that are not ``inside``."""
    both = (graph + graph.T).tocsr()
    starts, neighbours = both.indptr.tolist(), both.indices.tolist()
    level, open_ = height_mm.tolist(), inside.tolist()
    queue = [(level[k], k) for k in np.flatnonzero(~inside).tolist()]
    heapify(queue)
    while queue:
        at_mm, k = heappop(queue)
        for j in neighbours[starts[k] : starts[k + 1]]:
            if open_[j]:
                open_[j], level[j] = False, max(level[j], at_mm)
                heappush(queue, (level[j], j))
    return np.where(np.array(open_), height_mm, level)

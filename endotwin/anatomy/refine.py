"""Triangles of a part of a mesh are halved until their edges are short; the mesh stays as closed as it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse

from endotwin.surface import Surface

ROUNDS = 40

Moved = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, eq=False)
class Refined:
    """Some triangles of a surface, cut as finely as what happens to them needs it.

    Attributes:
        rest: float64 [P, 3], points, not yet moved. vertices: int [P], of the surface, the new ones last.
        triangles: [G, 3], of the points. origin: int [G], which of the surface's they are, or parts of.
        whole: bool [G], those that are not cut. gone: int, rows of the surface's triangles that are cut.
        weights: CSR [W, V], of the old vertices in the new ones.
    """

    rest: np.ndarray
    vertices: np.ndarray
    triangles: np.ndarray
    origin: np.ndarray
    whole: np.ndarray
    gone: np.ndarray
    weights: scipy.sparse.csr_array

    @classmethod
    def cut(
        cls,
        surface: Surface,
        rows: np.ndarray,
        framed: Callable[[np.ndarray], np.ndarray],
        moved: Moved,
        most_mm: float,
        least_mm: float,
    ) -> Refined:
        """Triangles ``rows`` [N] of the surface, whose vertices ``framed`` takes to the frame of ``rest``;
        other arguments are those of ``halved``."""
        count = len(surface.vertices_mm)
        old, corners = np.unique(surface.triangles[rows], return_inverse=True)
        rest = framed(surface.vertices_mm[old].astype(np.float64))
        rest, triangles, origin, whole, local = halved(rest, corners.reshape(-1, 3), moved, most_mm, least_mm)
        vertices = np.concatenate([old, np.arange(count, count + len(rest) - len(old))])
        chosen = (np.ones(len(old)), old, np.arange(len(old) + 1))
        between = local[len(old) :] @ scipy.sparse.csr_array(chosen, shape=(len(old), count))
        weights = scipy.sparse.vstack([scipy.sparse.eye_array(count), between], "csr")
        gone = np.delete(rows, origin[whole])
        return cls(rest, vertices, triangles, rows[origin], whole, gone, weights)

    def replaced(self, before: np.ndarray, values: np.ndarray) -> np.ndarray:
        """What the surface's triangles have, ``before`` [F, ...], with the ``values`` [G, ...] of these."""
        after = before.copy()
        after[self.origin[self.whole]] = values[self.whole]
        return np.concatenate([np.delete(after, self.gone, axis=0), values[~self.whole]])


def halved(
    points: np.ndarray, triangles: np.ndarray, moved: Moved, most_mm: float, least_mm: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, scipy.sparse.csr_array]:
    """Triangles halved at their longest edge (Rivara 1984) until they are small.

    Args:
        points: float64 [V, 3]. triangles: int [F, 3], in whose middle those lie that have a point that moves.
        moved: where points [N, 3] go, and bool [N], which of them move. most_mm: length of edges, after they
            have moved, to which triangles with such a point are halved; but not below ``least_mm`` before.

    Returns:
        points [W, 3], the first V of which are the same; triangles [G, 3]; which of the old ones each of them
        is, or is a part of, [G]; whether it is whole, bool [G]; and the weights CSR [W, V] of the old points
        in the new ones.
    """
    weights = scipy.sparse.eye_array(len(points), format="csr")
    origin, uncut = np.arange(len(triangles)), np.ones(len(triangles), bool)
    there, moves = moved(points)
    for _ in range(ROUNDS):
        edges, of = _edges(triangles, len(points))
        one, other = edges.T
        before_mm, after_mm = (np.linalg.norm(x[one] - x[other], axis=1) for x in (points, there))
        coarse = moves[triangles].any(axis=1) & (after_mm[of].max(axis=1) > most_mm)
        longest = np.take_along_axis(of, before_mm[of].argmax(axis=1)[:, None], axis=1)
        chosen = np.unique(longest[coarse])
        chosen = chosen[before_mm[chosen] > least_mm]
        if not len(chosen):
            break
        one, other = one[chosen], other[chosen]
        middle = np.full(len(edges), -1)
        middle[chosen] = len(points) + np.arange(len(chosen))
        weights = scipy.sparse.vstack([weights, (weights[one] + weights[other]) / 2], "csr")
        added = (points[one] + points[other]) / 2
        points = np.concatenate([points, added])
        there, moves = (np.concatenate(pair) for pair in zip((there, moves), moved(added), strict=True))
        whole = (middle[of] < 0).all(axis=1)
        parts, parents = _parts(triangles[~whole], middle[of][~whole], there)
        triangles = np.concatenate([triangles[whole], parts])
        origin = np.concatenate([origin[whole], origin[~whole][parents]])
        uncut = np.concatenate([uncut[whole], np.zeros(len(parts), bool)])
    return points, triangles, origin, uncut, weights


def _edges(triangles: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Edges [E, 2] of triangles [F, 3] of ``count`` points, and which of them follow each corner, [F, 3]."""
    ends = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1), axis=-1)
    codes, of = np.unique(ends[..., 0] * np.int64(count) + ends[..., 1], return_inverse=True)
    return np.stack([codes // count, codes % count], axis=1), of.reshape(-1, 3)


def _parts(triangles: np.ndarray, middle: np.ndarray, there: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles [F, 3] cut at the ``middle`` [F, 3] of the edges that follow their corners; -1: uncut. And
    which of them each part is of."""
    cuts = (middle >= 0).sum(axis=1)
    (a, b, c), (m, _, _) = _turned(triangles, middle, cuts == 1, lambda mid: mid >= 0)
    parts = [_stacked(a, m, c), _stacked(m, b, c)]
    (a, b, c), (m, n, _) = _turned(triangles, middle, cuts == 2, lambda mid: np.roll(mid, 1, axis=1) < 0)
    across_mm, other_mm = (np.linalg.norm(there[p] - there[q], axis=1) for p, q in ((a, n), (m, c)))
    shorter = (across_mm < other_mm)[:, None]
    parts += [
        _stacked(m, b, n),
        np.where(shorter, _stacked(a, m, n), _stacked(a, m, c)),
        np.where(shorter, _stacked(a, n, c), _stacked(m, n, c)),
    ]
    (a, b, c), (m, n, o) = triangles[cuts == 3].T, middle[cuts == 3].T
    parts += [_stacked(a, m, o), _stacked(m, b, n), _stacked(o, n, c), _stacked(m, n, o)]
    parents = [np.tile(np.flatnonzero(cuts == k), k + 1) for k in (1, 2, 3)]
    return np.concatenate(parts), np.concatenate(parents)


def _turned(
    triangles: np.ndarray, middle: np.ndarray, chosen: np.ndarray, first: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """The chosen triangles and their middles, [3, N] each, turned so that ``first`` comes first."""
    triangles, middle = triangles[chosen], middle[chosen]
    order = (first(middle).argmax(axis=1)[:, None] + np.arange(3)) % 3
    return tuple(np.take_along_axis(each, order, axis=1).T for each in (triangles, middle))


def _stacked(*corners: np.ndarray) -> np.ndarray:
    return np.stack(corners, axis=1)

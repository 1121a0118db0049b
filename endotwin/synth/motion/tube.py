"""Where each vertex lies about the centreline, and where it goes as the line bends and the lumen narrows.

A vertex v = c(s) + r goes to v' = c(s) + u(s) + M(s)·r with M = f·Q: u shifts the line, Q turns its tangent
to that of the shifted line, and f = 1 − a/R narrows the lumen of radius R by a. It is one to one as long as
f > 0 and the line bends less than the wall is away, so the tissue neither tears nor folds.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
import scipy.sparse
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch.nn.functional import embedding_bag

from endotwin.surface import Surface
from endotwin.surface.rows import Rows
from endotwin.surface.vectors import dot, scaled, unit
from endotwin.synth.trajectories.centerline import Centerline, arc_length, lengthened

SPACING_MM = 0.5
SMOOTHINGS = 60
"""Rounds by which places on the line are evened out among neighbouring vertices: where the line bends away
from a wall, the nearest place jumps."""


STEEPEST = 3.0
"""Greatest growth of the place on the line along the surface, on the inner side of a bend; in slivers of a
fused mesh it would have no bound."""


@dataclass(frozen=True, eq=False)
class Line:
    """The centreline, with a straight piece at both ends.

    Attributes:
        s_mm: float64 [S], way along it, 0 where the centreline begins. points: [S, 3], in the surface's
            frame. tangents: [S, 3]. radius_mm: [S], of the lumen. sideways: [3], the direction of shifts.
        length_mm: of the centreline.
    """

    s_mm: np.ndarray
    points: np.ndarray
    tangents: np.ndarray
    radius_mm: np.ndarray
    sideways: np.ndarray
    length_mm: float

    @classmethod
    def of(cls, centerline: Centerline, surface: Surface, reach_mm: float) -> Self:
        """The line, lengthened by ``reach_mm``."""
        points = lengthened(centerline.points_mm - surface.origin_mm, reach_mm, reach_mm)
        arc = arc_length(points)
        even = np.linspace(0, arc[-1], int(arc[-1] / SPACING_MM) + 2)
        points = np.stack([np.interp(even, arc, axis) for axis in points.T], axis=1)
        inner = np.linspace(0, centerline.length_mm, len(centerline.radius_mm))
        radius_mm = np.interp(even - reach_mm, inner, centerline.radius_mm)
        chord = unit(points[-1] - points[0])
        sideways = np.eye(3)[np.abs(chord).argmin()]
        sideways = unit(sideways - chord * (chord @ sideways))
        tangents = unit(np.gradient(points, axis=0))
        return cls(even - reach_mm, points, tangents, radius_mm, sideways, centerline.length_mm)

    @cached_property
    def tree(self) -> cKDTree:
        """Of its points."""
        return cKDTree(self.points)

    def bent(self, contraction_mm: np.ndarray, shift_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The shift u [S, 3] and the matrix M [S, 3, 3] of each place, of a contraction and a shift [S]."""
        shift = shift_mm[:, None] * self.sideways
        turned = unit(np.gradient(self.points + shift, axis=0))
        Q = Rotation.from_rotvec(_turn(self.tangents, turned)).as_matrix()
        return shift, (1 - contraction_mm / self.radius_mm)[:, None, None] * Q


@dataclass(frozen=True, eq=False)
class Places(Rows):
    """Points on or about the line.

    Attributes:
        below: int [N], station of the line before each point. share: float [N], of the way to the next one.
        across: [N, 3], r. slope: [N, 3], how s grows along the surface.
    """

    below: np.ndarray
    share: np.ndarray
    across: np.ndarray
    slope: np.ndarray

    @classmethod
    def of(cls, line: Line, points: np.ndarray, surface: Surface | None = None) -> Self:
        """Of ``points`` [N, 3]; where they are the vertices of ``surface``, evened out along it."""
        s_mm = nearest(line, points)
        if surface is not None:
            s_mm = _evened(s_mm, surface)
        at = np.clip((s_mm - line.s_mm[0]) / (line.s_mm[1] - line.s_mm[0]), 0, len(line.s_mm) - 1.001)
        below = at.astype(np.int32)
        slope = np.zeros(points.shape) if surface is None else _gradient(s_mm, surface)
        slope /= np.maximum(np.linalg.norm(slope, axis=1, keepdims=True) / STEEPEST, 1)
        found = cls(below, (at - below).astype(np.float32), np.zeros(0), slope.astype(np.float32))
        across = (points - found.of_table(line.points)).astype(np.float32)
        return cls(below, found.share, across, found.slope)

    def of_table(self, table: np.ndarray) -> np.ndarray:
        """Values of a table [S, ...] of the line's stations at the points, [N, ...]."""
        share = self.share.reshape(-1, *(1,) * (table.ndim - 1)).astype(table.dtype)
        low = table.take(self.below, axis=0)
        return low + share * (table.take(self.below + 1, axis=0) - low)


class Sums:
    """Sums Σₖ factor[k]·row[k] at N points of K rows of three that each station of the line has."""

    def __init__(self, places: Places, *factors: np.ndarray):
        """``factors``: float32 [N, K] in all, side by side."""
        factor = np.concatenate(factors, axis=1)
        self._rows = factor.shape[1]
        share = places.share[:, None]
        self._weight = torch.from_numpy(np.concatenate([(1 - share) * factor, share * factor], axis=1))
        both = np.arange(2 * self._rows, dtype=np.int32)
        self._index = torch.from_numpy(places.below[:, None] * np.int32(self._rows) + both)

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        """Of ``rows`` [S, K, 3], float32 [N, 3]."""
        table = torch.from_numpy(rows.astype(np.float32).reshape(-1, 3))
        return embedding_bag(self._index, table, mode="sum", per_sample_weights=self._weight).numpy()


class Carried:
    """Points float32 [N, 3] that the tissue takes along, with ``normals`` [N, 3] if given."""

    def __init__(self, line: Line, places: Places, points: np.ndarray, normals: np.ndarray | None = None):
        self._line, self._places, self._points = line, places, points
        self._across = Sums(places, np.ones((len(points), 1), np.float32), places.across)
        if normals is not None:
            self._along, self._slope = Sums(places, normals), Sums(places, places.slope)

    def moved(self, shift: np.ndarray, M: np.ndarray) -> np.ndarray:
        """Where the points go, float32 [N, 3]."""
        return self._points + self._across(_stacked(shift, M - np.eye(3)))

    def turned(self, shift: np.ndarray, M: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Unit normals [N, 3] of the moved surface, and the space about it, [N]: below 0 where it is folded.

        The map's gradient is J = M + w·∇sᵀ, w = u' + M'·r − (M − 1)·t, and a normal goes to J⁻ᵀ·n (by
        Sherman & Morrison, with M⁻ᵀ = M/f²).
        """
        line = self._line
        step_mm = line.s_mm[1] - line.s_mm[0]
        rates = [np.gradient(table, step_mm, axis=0) for table in (shift, M)]
        own = np.einsum("sij,sj->si", M - np.eye(3), line.tangents)
        w, rows = self._across(_stacked(rates[0] - own, rates[1])), M.transpose(0, 2, 1)
        normals, slope = self._along(rows), self._slope(rows)
        space = self._places.of_table((M[:, 0] ** 2).sum(axis=1).astype(np.float32)) + dot(slope, w)
        return unit(normals - scaled(slope, dot(w, normals) / space)), space


def _stacked(u: np.ndarray, M: np.ndarray) -> np.ndarray:
    """Rows [S, 4, 3] whose sum by the factors 1, x, y, z is u + M·(x, y, z), of u [S, 3] and M [S, 3, 3]."""
    return np.concatenate([u[:, None], M.transpose(0, 2, 1)], axis=1)


def _turn(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Rotation vectors [S, 3] of the least turns that take unit vectors [S, 3] to others."""
    axis = np.cross(one, other)
    sine = np.linalg.norm(axis, axis=1, keepdims=True)
    return axis / np.maximum(sine, 1e-12) * np.arctan2(sine, dot(one, other)[:, None])


def nearest(line: Line, points: np.ndarray) -> np.ndarray:
    """Way along the line, mm, to its place nearest to each of ``points`` [N, 3], [N]."""
    station = line.tree.query(points)[1]
    ahead = dot(points - line.points[station], line.tangents[station])
    return line.s_mm[station] + np.clip(ahead, -SPACING_MM, SPACING_MM)


def _evened(s_mm: np.ndarray, surface: Surface) -> np.ndarray:
    """Places [V] as means of their own and their neighbours', SMOOTHINGS times over."""
    one = surface.triangles.ravel()
    other = np.roll(surface.triangles, 1, axis=1).ravel()
    ones = np.ones(2 * len(one), np.float32)
    pairs = (np.concatenate([one, other]), np.concatenate([other, one]))
    joined = scipy.sparse.csr_array((ones, pairs), shape=(len(s_mm), len(s_mm)))
    neighbours = np.asarray(joined.sum(axis=1)).ravel()
    for _ in range(SMOOTHINGS):
        around = (joined @ s_mm) / np.maximum(neighbours, 1)
        s_mm = np.where(neighbours > 0, 0.5 * (s_mm + around), s_mm)
    return s_mm


def _gradient(values: np.ndarray, surface: Surface) -> np.ndarray:
    """Gradient [V, 3] along the surface of ``values`` [V]: that of each triangle, by area."""
    corners = surface.vertices_mm[surface.triangles].astype(np.float64)
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.sqrt(dot(facing, facing))
    n = facing / np.maximum(area, 1e-12)[:, None]
    opposite = np.roll(corners, -2, axis=1) - np.roll(corners, -1, axis=1)
    risen = sum(values[surface.triangles[:, k], None] * np.cross(n, opposite[:, k]) for k in range(3))
    total = np.zeros((len(values), 3))
    weight = np.zeros(len(values))
    for k in range(3):
        vertex = surface.triangles[:, k]
        weight += np.bincount(vertex, area, len(values))
        total += np.stack([np.bincount(vertex, column, len(values)) for column in risen.T], axis=1)
    return total / np.maximum(weight, 1e-12)[:, None]

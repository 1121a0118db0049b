"""Sparkles: the facets of a fluid's rough surface, each a mirror of its own, one by one.

A film that is rough below a pixel is no smooth lobe but many small facets, of which a camera sees those few
that mirror a light guide to it (Jakob et al. 2014, "Discrete stochastic microfacet models"). Facets lie on
each triangle as a Poisson process, and their slopes have the GGX distribution of the whole: so many of them
together are the smooth lobe, whatever their density. A slope s becomes a place d = s/√(α² + s²) in the unit
disk, on which GGX is even; the disk has cells, and what lies in one cell of one triangle is drawn from a hash
of the two. So only facets about the mirror direction are ever made, and they are the same ones in every view
(Zirr & Kaplanyan 2016 and Deliot & Belcour 2023 count them so, rather than place them).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from endotwin.surface.rows import Rows
from endotwin.surface.vectors import dot, unit

REACH = 3.0
"""Beyond so many widths of its own lobe a facet is dark: e⁻⁹ of its peak."""


@dataclass(frozen=True, eq=False)
class Facing(Rows):
    """How F triangles face: unit normals and two tangents each, float32 [F, 3], by the first edge; so the
    frame moves with tissue that does."""

    normal: np.ndarray
    first: np.ndarray
    second: np.ndarray

    @classmethod
    def of(cls, vertices_mm: np.ndarray, normals: np.ndarray, triangles: np.ndarray) -> Facing:
        """Of ``triangles`` [F, 3], whose normals are the means of their corners'."""
        normal = unit(normals[triangles].sum(axis=1))
        edge = vertices_mm[triangles[:, 1]] - vertices_mm[triangles[:, 0]]
        first = unit(edge - dot(edge, normal)[:, None] * normal)
        return cls(normal, first, np.cross(normal, first))

    def slope(self, direction: np.ndarray) -> np.ndarray:
        """Slopes [F, ..., 2] of the microfacets whose normals [F, ..., 3] those are; inf where they face
        away."""
        axes = np.stack([self.first, self.second, self.normal], axis=1)
        along, across, up = np.moveaxis(np.einsum("fad,f...d->f...a", axes, direction), -1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(up[..., None] > 0, np.stack([along, across], axis=-1) / up[..., None], np.inf)


@dataclass(frozen=True, eq=False)
class Facets(Rows):
    """N facets.

    Attributes:
        row: int [N], of each one's triangle. barycentric: float32 [N, 3]. slope: float32 [N, 2], in its
            ``Facing``. share: float32 [N], how large it is beside their mean; areas are exponential.
    """

    row: np.ndarray
    barycentric: np.ndarray
    slope: np.ndarray
    share: np.ndarray

    def __len__(self) -> int:
        return len(self.row)


def lobe(apart2: np.ndarray, width: float) -> np.ndarray:
    """Distribution [N] of a facet's own slopes at a squared distance [N] from its middle: Beckmann's, of
    integral 1."""
    return np.exp(-apart2 / width**2) / (math.pi * width**2)


def facets_about(
    name: np.ndarray, area_mm2: np.ndarray, slopes: np.ndarray, density: float, spread: float, width: float
) -> Facets:
    """The facets of F triangles that may shine where the half vector has ``slopes``, and some beside them.

    Args:
        name: int [F], by which each triangle is known in every view. area_mm2: [F]. slopes: [F, 3, 2], of the
            half vector at the corners, not finite where there is none. density: facets a mm². spread: α of
            all facets together. width: α of each one's own lobe.
    """
    cells, reach = _cells(density * area_mm2), REACH * width / spread
    lit = np.flatnonzero(np.isfinite(slopes).all(axis=(1, 2)))
    disk = slopes[lit] / np.sqrt(spread**2 + (slopes[lit] ** 2).sum(axis=-1, keepdims=True))
    ends = np.stack([disk.min(axis=1) - reach, disk.max(axis=1) + reach])
    across = cells[lit, None]
    low, high = np.clip(np.floor((ends + 1) / 2 * across), 0, across - 1).astype(np.int64)
    size = high - low + 1
    box, within = _repeated(size.prod(axis=1))
    row = lit[box]
    cell = low[box] + np.stack(np.divmod(within, size[box, 1]), axis=1)
    key = _hashed(name[row], cell[:, 0], cell[:, 1])
    edge = 2 / cells[row, None]
    mean = density * area_mm2[row] * edge[:, 0] ** 2 / math.pi
    at, which = _repeated(_drawn(_uniform(_hashed(key, 0)), mean))
    key = _hashed(key[at], 1 + which)
    u = [_uniform(_hashed(key, each)) for each in range(5)]
    place = (cell[at] + np.stack(u[:2], axis=1)) * edge[at] - 1
    radius2 = (place**2).sum(axis=1, keepdims=True)
    inside = radius2[:, 0] < 1
    root = np.sqrt(u[2])
    found = (
        np.stack([1 - root, root * (1 - u[3]), root * u[3]], axis=1),
        spread * place / np.sqrt(np.where(inside[:, None], 1 - radius2, 1)),
        -np.log1p(-u[4]),
    )
    return Facets(row[at], *(each.astype(np.float32) for each in found))[inside]


def bare(name: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Bool [F]: triangles of so many ``expected`` facets [F] that have none at all, whatever the view; only
    those that expect a few are told."""
    empty = _uniform(_hashed(_hashed(name, 0, 0), 0)) < np.exp(-expected * 4 / math.pi)
    return empty & (_cells(expected) == 1)


def _cells(expected: np.ndarray) -> np.ndarray:
    """Cells across the disk of triangles of so many ``expected`` facets, int [F]: a cell has about one."""
    return np.maximum(np.sqrt(expected), 1).astype(np.int64)


def _repeated(count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Row [N] and number within it [N] of ``count`` [R] things in each row."""
    row = np.repeat(np.arange(len(count)), count)
    return row, np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)


def _drawn(u: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Poisson numbers [N] of ``mean`` [N], a few at most, by inversion of ``u`` [N] in [0, 1)."""
    count, chance = np.zeros(len(u), np.int64), np.exp(-mean)
    more = np.flatnonzero(u >= chance)
    left, chance, mean = u[more] - chance[more], chance[more], mean[more]
    while len(more):
        count[more] += 1
        chance = chance * mean / count[more]
        left = left - chance
        still = (left >= 0) & (chance > 0)
        more, left, chance, mean = more[still], left[still], chance[still], mean[still]
    return count


def _hashed(*keys: np.ndarray | int) -> np.ndarray:
    """Uint64 [N] of integers [N], each bit of which depends on all of theirs (Steele et al. 2014,
    SplitMix64)."""
    found = np.uint64(0)
    with np.errstate(over="ignore"):
        for key in keys:
            found = (found ^ np.asarray(key).astype(np.uint64)) + np.uint64(0x9E3779B97F4A7C15)
            found = (found ^ (found >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            found = (found ^ (found >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            found = found ^ (found >> np.uint64(31))
    return found


def _uniform(hashed: np.ndarray) -> np.ndarray:
    """In [0, 1), float64 [N]."""
    return (hashed >> np.uint64(11)).astype(np.float64) * 2.0**-53

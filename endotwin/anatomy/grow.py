"""Polyps grown on a twin: its mesh is refined where they stand and moved, its materials follow."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse

from endotwin.anatomy.carried import carried_film, coverage, kept
from endotwin.anatomy.refine import Refined
from endotwin.anatomy.shape import Shape, diameter
from endotwin.anatomy.site import Site
from endotwin.errors import OptionError
from endotwin.surface import Surface
from endotwin.surface.vectors import unit
from endotwin.twin import Materials, Twin
from endotwin.twin.polyps import Polyp, numbered

EDGES = 30
"""Edges that a polyp's size is long, as far as FINEST_MM and COARSEST_MM allow."""
FINEST_MM, COARSEST_MM = 0.08, 0.3

AROUND = 1.6
"""Wall within so many radii of the disc gives the colour that a polyp's own departs from."""

EVENED = 0.6
"""Share of the wall's own pattern that a polyp loses."""

IHB = 32.0
"""Of the index of haemoglobin, 32·log2(R/G) of displayed values (Yao et al., Endoscopy 2005; 37: 479)."""

MOTTLED = 0.06
"""Standard deviation by which a polyp's base colour swings with its bumps."""

DIFFERENCE = 1e-3
"""Of finite differences, as a share of the distance from the axis."""


@dataclass(frozen=True, eq=False)
class Seedling:
    """A polyp to be: its shape and site, and how much greater its index of haemoglobin is than the wall's."""

    shape: Shape
    site: Site
    ihb: float


def grown(twin: Twin, seedlings: Iterable[Seedling]) -> tuple[Twin, scipy.sparse.csr_array]:
    """The fitted twin with polyps, and the weights CSR [W, V] of its old vertices in the new ones.

    The first V vertices are the old ones, which stay bit for bit where no polyp stands, and so do triangles;
    those of each polyp come last.

    Raises:
        OptionError: the mesh is too coarse for one.
    """
    numbers = numbered((each.triangles for each in twin.polyps), len(twin.surface.triangles))
    carried, polyps = scipy.sparse.eye_array(len(twin.surface.vertices_mm), format="csr"), list(twin.polyps)
    for seedling in seedlings:
        twin, numbers, weights, polyp = _with_one(twin, numbers, seedling, len(polyps) + 1)
        carried, polyps = weights @ carried, [*polyps, polyp]
    order = np.argsort(numbers, kind="stable")
    ends = np.cumsum(np.bincount(numbers, minlength=len(polyps) + 1))
    polyps = [
        replace(each, triangles=(int(ends[k]), int(ends[k + 1] - ends[k]))) for k, each in enumerate(polyps)
    ]
    surface = replace(twin.surface, triangles=twin.surface.triangles[order])
    return replace(twin, surface=surface, polyps=tuple(polyps)), carried.tocsr()


def _with_one(
    twin: Twin, numbers: np.ndarray, seedling: Seedling, number: int
) -> tuple[Twin, np.ndarray, scipy.sparse.csr_array, Polyp]:
    """The twin with one more polyp; the polyps' numbers [F]; the weights of its vertices; the polyp."""
    surface, shape, site = twin.surface, seedling.shape, seedling.site
    patch = _Patch(site, shape)
    fine, around = _refined(surface, patch)
    rest, triangles, weights = fine.rest, fine.triangles, fine.weights
    inside = patch.inside(rest)
    moves = fine.vertices[inside]
    t = np.where(inside, patch.t(rest), np.inf)
    own = t[triangles].max(axis=1) <= shape.edge
    if own.sum() < EDGES:
        raise OptionError(
            f"the mesh is too coarse for a polyp of {shape.size_mm:g} mm; fuse the twin with smaller voxels"
        )
    normals = unit(weights @ surface.normals.astype(np.float64))
    placed, turned = patch.grown(rest[inside], normals[moves] @ site.axes.T)
    vertices_mm = weights @ surface.vertices_mm.astype(np.float64)
    if not shape.flat:
        vertices_mm[moves] = site.placed(placed)
    changed = moves[:0] if shape.flat else moves
    turn = turned @ site.axes - normals[moves]
    normals[moves] += turn
    grown_surface = replace(
        surface,
        vertices_mm=kept(surface.vertices_mm, vertices_mm, changed),
        triangles=fine.replaced(surface.triangles, fine.vertices[triangles]).astype(np.int32),
        normals=kept(surface.normals, normals, changed),
        **coverage(surface, weights),
    )
    colors = _Colors(shape, seedling.ihb / IHB / twin.response.gamma, moves, t[inside], placed)
    materials = _materials(twin.materials, weights, colors, around)
    if materials.film is not None:
        materials = replace(materials, film=carried_film(materials.film, weights, moves, turn))
    numbers = fine.replaced(numbers, np.where(own, np.uint8(number), numbers[fine.origin]))
    rest[inside] = placed
    polyp = _measured(shape, site, rest, triangles[own], t, surface.origin_mm)
    return replace(twin, surface=grown_surface, materials=materials), numbers, weights, polyp


def _refined(surface: Surface, patch: _Patch) -> tuple[Refined, np.ndarray]:
    """The triangles about a site, in its frame, as finely cut as the polyp that they become needs it; and
    vertices [N] of the wall about it."""
    site, shape, count = patch.site, patch.shape, len(surface.vertices_mm)
    touched = np.zeros(count, bool)
    touched[surface.triangles[site.near(surface, AROUND * shape.radius_mm)]] = True
    near = np.flatnonzero(touched[surface.triangles].any(axis=1))
    most_mm = float(np.clip(shape.size_mm / EDGES, FINEST_MM, COARSEST_MM))
    least_mm = most_mm / shape.magnified / 4
    fine = Refined.cut(surface, near, site.within, patch.moved, most_mm, least_mm)
    old = fine.vertices < count
    rest = fine.rest[old]
    around = ~patch.inside(rest) & (patch.t(rest) < AROUND) & site.along(rest)
    return fine, fine.vertices[old][around]


class _Patch:
    """The wall that a polyp is made of, in the site's frame."""

    def __init__(self, site: Site, shape: Shape):
        self.site, self.shape = site, shape

    def t(self, rest: np.ndarray) -> np.ndarray:
        """``Shape.t`` of points [N, 3]."""
        return self.shape.t(rest[:, :2])

    def inside(self, rest: np.ndarray) -> np.ndarray:
        """Bool [N]: points that the polyp is made of."""
        return (self.t(rest) < 1) & self.site.along(rest)

    def moved(self, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where points [N, 3] go, and which of them do."""
        inside, there = self.inside(rest), rest.copy()
        there[inside] = self._grown(rest[inside])
        return there, inside

    def grown(self, rest: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where points [N, 3] with ``normals`` [N, 3] go, and their normals there."""
        if self.shape.flat:
            return rest, normals
        step = DIFFERENCE * (
            np.linalg.norm(rest[:, :2], axis=1) + self.shape.radius_mm / self.shape.magnified
        )
        sides = []
        for axis in np.eye(2):
            ahead, behind = (
                self.site.grown(self.shape, rest[:, :2] + sign * step[:, None] * axis) for sign in (1.0, -1.0)
            )
            sides.append((ahead - behind) / step[:, None])
        facing = unit(np.cross(*sides))
        _, b, c, aa, ab, bb = self.site.bend
        slope = rest[:, :2] @ np.array([[2 * aa, ab], [ab, 2 * bb]]) + [b, c]
        level = unit(np.c_[-slope, np.ones(len(rest))])
        return self._grown(rest), unit(facing + self._rough(rest)[:, None] * (normals - level))

    def _grown(self, rest: np.ndarray) -> np.ndarray:
        if self.shape.flat:
            return rest
        moved = self.site.grown(self.shape, rest[:, :2])
        moved[:, 2] += self._rough(rest) * (rest[:, 2] - self.site.height_mm(rest[:, :2]))
        return moved

    def _rough(self, rest: np.ndarray) -> np.ndarray:
        """Share of the wall's own unevenness [N] that is left."""
        return 1 - self.shape.own(self.t(rest))


@dataclass(frozen=True, eq=False)
class _Colors:
    """What becomes of the base colour of ``vertices`` [N] at ``t`` [N] and ``points`` [N, 3], log2(R/G) of
    which grows by ``redder``."""

    shape: Shape
    redder: float
    vertices: np.ndarray
    t: np.ndarray
    points: np.ndarray

    def of(self, color: np.ndarray, around: np.ndarray) -> np.ndarray:
        """Base colours [N, 3] of what was ``color`` [N, 3], in wall of the colours ``around`` [M, 3]."""
        own = self.shape.own(self.t)[:, None]
        wall = np.maximum(np.median(around, axis=0), 1e-3)
        even = color * (wall / np.maximum(color, 1e-3)) ** (EVENED * own)
        redder = 2**-self.redder
        mottled = np.exp(MOTTLED * self.shape.mottling(self.points))[:, None]
        return even * (np.array([1, redder, redder]) * mottled) ** own


def _materials(
    materials: Materials, weights: scipy.sparse.csr_array, colors: _Colors, around: np.ndarray
) -> Materials:
    """Those of the new vertices, between their neighbours', and the polyp's own colour."""
    arrays = {}
    for name, values in materials.per_vertex.items():
        after = weights @ values.astype(np.float64)
        changed = np.zeros(0, int)
        if name == "base_color":
            changed = colors.vertices
            wall = after[around] if len(around) else after[changed]
            after[changed] = colors.of(after[changed], wall)
        arrays[name] = kept(values, np.clip(after, 0, 1), changed)
    return replace(materials, **arrays)


def _measured(
    shape: Shape, site: Site, placed: np.ndarray, own: np.ndarray, t: np.ndarray, origin_mm: np.ndarray
) -> Polyp:
    """The polyp of the triangles ``own`` [N, 3] of points ``placed`` [P, 3], in the site's frame."""
    points = np.unique(own)
    head = points[t[points] <= shape.head]
    above = placed[points, 2] - site.height_mm(placed[points, :2])
    return Polyp(
        kind=shape.kind,
        size_mm=round(diameter(placed[head, :2]), 3),
        height_mm=0.0 if shape.flat else round(float(above[np.abs(above).argmax()]), 3),
        place_mm=tuple(round(float(x), 3) for x in site.foot_mm + origin_mm),
        axis=tuple(round(float(x), 5) for x in site.axes[2]),
        triangles=(0, 0),
    )

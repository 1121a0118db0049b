"""Fluids on a twin: its mesh is refined where they lie and moved to their surface, which has their colour."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
from scipy.spatial.distance import pdist

from endotwin.anatomy import spread
from endotwin.anatomy.carried import carried_film, coverage, kept
from endotwin.anatomy.optics import Optics
from endotwin.anatomy.refine import Refined
from endotwin.anatomy.shape import smoothstep
from endotwin.surface import Surface
from endotwin.surface.casting import Caster
from endotwin.surface.vectors import unit
from endotwin.twin import Materials, Twin
from endotwin.twin.fluids import Fluid, covered
from endotwin.twin.polyps import numbered

EDGES = 60
"""Edges that a patch is long, as far as FINEST_MM and COARSEST_MM allow."""
FINEST_MM, COARSEST_MM = 0.1, 0.25

FLOOR = 0.1
"""Least cosine between the floor of a pool and the vertical."""

SHALLOWEST_MM = 0.3
"""A pool is deeper somewhere."""

LEAST_MM = 1e-3
"""Fluid that is thinner is none."""

LEVELLED_MM = 0.3
"""A layer so thick shows nothing of the relief below it."""

WET_MM = 0.05
"""A layer so thick has a surface of its own."""

ROOM = 1.2
"""A layer needs so many times its thickness, and ROOM_MM, above it."""
ROOM_MM = 0.05

SPREADS = {"film": spread.film, "strands": spread.strands, "lumps": spread.lumps}

MOST_POINTS = 2000
"""By which the extent of a patch is measured."""


@dataclass(frozen=True, eq=False)
class Puddle:
    """A patch of fluid to be.

    Attributes:
        kind: its name. optics: of the fluid. spread: how it lies: one of SPREADS, or ``pool``.
        size_mm: greatest extent along the mesh. thickness_mm: greatest, of a pool its greatest depth.
        down: unit vector [3] along gravity. start_mm: [3], where it spreads from, in the surface's frame.
        generator: of its shape.
    """

    kind: str
    optics: Optics
    spread: str
    size_mm: float
    thickness_mm: float
    down: np.ndarray
    start_mm: np.ndarray
    generator: np.random.Generator

    @property
    def pool(self) -> bool:
        return self.spread == "pool"

    @property
    def reach_mm(self) -> float:
        """Of the mesh that is looked at; the lowest point about the start may lie half a size from it."""
        return self.size_mm * (1.05 if self.pool else 0.55)


class Wetted:
    """A fitted twin to which fluids are added, one after the other.

    Attributes:
        twin: with those so far. weights: CSR [W, V], of the first twin's vertices in those of this one.
    """

    def __init__(self, twin: Twin):
        self.twin, self._caster = twin, Caster(twin.surface)
        count = len(twin.surface.triangles)
        self._polyps = numbered((each.triangles for each in twin.polyps), count)
        self._fluids = covered((each.triangles for each in twin.fluids), count)
        self.weights = scipy.sparse.eye_array(len(twin.surface.vertices_mm), format="csr")

    def add(self, puddle: Puddle) -> str:
        """Let it lie on the twin; or what hinders it, as the end of a sentence, and nothing changes."""
        surface = self.twin.surface
        fine = _refined(surface, puddle)
        normals = unit(fine.weights[fine.vertices] @ surface.normals.astype(np.float64))
        layer = _layer(puddle, fine, normals)
        on = layer.thickness_mm[fine.triangles].max(axis=1) > 0
        fault = self._fault(puddle, fine, layer, on)
        if not fault:
            self._lay(puddle, fine, layer, normals, on)
        return fault

    def _fault(self, puddle: Puddle, fine: Refined, layer: _Layer, on: np.ndarray) -> str:
        if not on.any():
            return "it would run off" if puddle.pool else "the mesh is too coarse"
        if self._fluids[fine.origin[on]].any():
            return "another fluid lies there"
        thick = layer.thickness_mm > LEAST_MM
        start, towards = fine.rest[thick], layer.towards[thick]
        way_mm = ROOM * layer.thickness_mm[thick] + ROOM_MM
        free = self._caster.unobstructed(
            (start + LEAST_MM * towards).astype(np.float32), towards.astype(np.float32), way_mm
        )
        return "" if free.all() else "the lumen is too narrow there"

    def _lay(self, puddle: Puddle, fine: Refined, layer: _Layer, normals: np.ndarray, on: np.ndarray) -> None:
        twin, surface, weights = self.twin, self.twin.surface, fine.weights
        number = len(twin.fluids) + 1
        wet = np.flatnonzero(layer.thickness_mm > 0)
        moves = fine.vertices[wet]
        placed = fine.rest + layer.thickness_mm[:, None] * layer.towards
        after = _levelled(fine.triangles, fine.rest, placed, normals, layer.thickness_mm)
        vertices_mm = weights @ surface.vertices_mm.astype(np.float64)
        turned = unit(weights @ surface.normals.astype(np.float64))
        vertices_mm[moves] = placed[wet]
        turned[fine.vertices] = after
        changed = np.union1d(moves, fine.vertices[np.unique(fine.triangles[on])])
        laid = Surface(
            surface.origin_mm,
            kept(surface.vertices_mm, vertices_mm, moves),
            fine.replaced(surface.triangles, fine.vertices[fine.triangles]).astype(np.int32),
            kept(surface.normals, turned, changed),
            *coverage(surface, weights),
        )
        materials = _materials(twin.materials, weights, puddle.optics, moves, layer.thickness_mm[wet])
        if materials.film is not None:
            turn = after[wet] - normals[wet]
            materials = replace(materials, film=carried_film(materials.film, weights, moves, turn))
        self._polyps = fine.replaced(self._polyps, self._polyps[fine.origin])
        mine = np.where(on, np.uint8(number), self._fluids[fine.origin])
        self._fluids = fine.replaced(self._fluids, mine)
        self.weights = weights @ self.weights
        fluid = _measured(puddle, placed[wet], layer.thickness_mm[wet], surface.origin_mm)
        self.twin = replace(twin, surface=laid, materials=materials, fluids=(*twin.fluids, fluid))

    def finished(self) -> Twin:
        """The twin, its triangles in the order of polyps and of fluids on them."""
        order = np.lexsort((self._fluids, self._polyps))
        polyps, fluids = self._polyps[order], self._fluids[order]
        surface = replace(self.twin.surface, triangles=self.twin.surface.triangles[order])
        return replace(
            self.twin,
            surface=surface,
            polyps=tuple(
                replace(each, triangles=_runs(polyps == number)[0])
                for number, each in enumerate(self.twin.polyps, 1)
            ),
            fluids=tuple(
                replace(each, triangles=_runs(fluids == number))
                for number, each in enumerate(self.twin.fluids, 1)
            ),
        )


@dataclass(frozen=True, eq=False)
class _Layer:
    """Of points: float64 [P], how thick fluid lies on them, and unit vectors [P, 3] to its surface."""

    thickness_mm: np.ndarray
    towards: np.ndarray


def _refined(surface: Surface, puddle: Puddle) -> Refined:
    """The triangles about where it spreads from."""

    def near(points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points - puddle.start_mm, axis=1) < puddle.reach_mm

    touched = near(surface.vertices_mm.astype(np.float64))
    for _ in range(2):  # and those about them, which share their edges
        rows = touched[surface.triangles].any(axis=1)
        touched[surface.triangles[rows]] = True
    most_mm = float(np.clip(puddle.size_mm / EDGES, FINEST_MM, COARSEST_MM))
    return Refined.cut(
        surface,
        np.flatnonzero(rows),
        lambda points: points,
        lambda points: (points, near(points)),
        most_mm,
        most_mm / 4,
    )


def _layer(puddle: Puddle, fine: Refined, normals: np.ndarray) -> _Layer:
    graph = spread.edges_of(fine.rest, fine.triangles)
    start = int(np.linalg.norm(fine.rest - puddle.start_mm, axis=1).argmin())
    far_mm = spread.along_mesh(graph, start, puddle.reach_mm)
    if puddle.pool:
        up = -puddle.down
        height_mm = fine.rest @ up
        lowest = int(np.where(far_mm < puddle.size_mm / 2, height_mm, np.inf).argmin())
        about_mm = spread.along_mesh(graph, lowest, puddle.size_mm / 2)
        allowed = (about_mm < puddle.size_mm / 2) & (far_mm < puddle.reach_mm) & (normals @ up > FLOOR)
        depth_mm = spread.pool_mm(height_mm, allowed, graph, lowest, puddle.thickness_mm)
        depth_mm[depth_mm < LEAST_MM] = 0
        return _Layer(depth_mm * (depth_mm.max() > SHALLOWEST_MM), np.broadcast_to(up, normals.shape))
    run = unit(puddle.down - (puddle.down @ normals[start]) * normals[start])
    ragged, uneven = (spread.noise(puddle.size_mm, run, puddle.generator)(fine.rest) for _ in range(2))
    share = SPREADS[puddle.spread](spread.within(far_mm, puddle.size_mm, ragged), uneven)
    towards = normals
    if puddle.spread == "lumps":
        axis = unit((share[:, None] * normals).sum(axis=0))
        share = share * smoothstep((normals @ axis - 0.2) / 0.4)
        towards = np.broadcast_to(axis, normals.shape)
    thickness_mm = puddle.thickness_mm * share
    thickness_mm[thickness_mm < LEAST_MM] = 0
    return _Layer(thickness_mm, towards)


def _levelled(
    triangles: np.ndarray,
    rest: np.ndarray,
    placed: np.ndarray,
    normals: np.ndarray,
    thickness_mm: np.ndarray,
) -> np.ndarray:
    """Normals [P, 3] after the move from ``rest`` to ``placed`` [P, 3]: they turn with the mesh, and thick
    fluid hides by how much they were off it."""
    before, after = (_facing(points, triangles) for points in (rest, placed))
    hidden = smoothstep(thickness_mm / LEVELLED_MM)[:, None]
    return unit(after + (1 - hidden) * (normals - before))


def _facing(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Unit normals [P, 3] of a mesh, means over the area about each point."""
    a, b, c = points[triangles].transpose(1, 0, 2)
    area, total = np.cross(b - a, c - a), np.zeros(points.shape)
    for corner in triangles.T:
        np.add.at(total, corner, area)
    return unit(total)


def _materials(
    materials: Materials,
    weights: scipy.sparse.csr_array,
    optics: Optics,
    wet: np.ndarray,
    thickness_mm: np.ndarray,
) -> Materials:
    """Those of the new vertices, between their neighbours', and the fluid's on the ``wet`` ones [N]."""
    arrays = {name: weights @ values.astype(np.float64) for name, values in materials.per_vertex.items()}
    covers = smoothstep(thickness_mm / WET_MM)
    substrate = arrays["base_color"][wet] * (1 - arrays["metallic"][wet])[:, None]
    arrays["base_color"][wet] = optics.over(substrate, thickness_mm)
    arrays["metallic"][wet] = 0
    arrays["roughness"][wet] += covers * (optics.roughness - arrays["roughness"][wet])
    before = materials.per_vertex
    return replace(
        materials,
        **{name: kept(before[name], np.clip(values, 0, 1), wet) for name, values in arrays.items()},
    )


def _measured(puddle: Puddle, points: np.ndarray, thickness_mm: np.ndarray, origin_mm: np.ndarray) -> Fluid:
    some = points[:: -(-len(points) // MOST_POINTS)]
    return Fluid(
        kind=puddle.kind,
        size_mm=round(float(pdist(some).max()), 3),
        thickness_mm=round(float(thickness_mm.max()), 4),
        pool=puddle.pool,
        place_mm=tuple(round(float(x), 3) for x in puddle.start_mm + origin_mm),
        triangles=(),
    )


def _runs(chosen: np.ndarray) -> tuple[tuple[int, int], ...]:
    """Runs of ``chosen``, bool [F]: the first of each, and how many."""
    ends = np.flatnonzero(np.diff(np.r_[False, chosen, False].astype(np.int8)))
    return tuple((int(first), int(end - first)) for first, end in ends.reshape(-1, 2))

"""Fluids on a twin: its mesh is refined where they lie and moved to their surface, which has their colour."""

from __future__ import annotations

from collections.abc import Callable
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
from endotwin.surface.vectors import dot, unit
from endotwin.twin import Materials, Twin
from endotwin.twin.fluids import Fluid, covered
from endotwin.twin.polyps import numbered

EDGES = 60
"""Edges that a patch is long, as far as FINEST_MM and COARSEST_MM allow."""
FINEST_MM, COARSEST_MM = 0.1, 0.25

FLOOR = 0.1
"""Least cosine between the floor of a pool and the vertical."""

SHALLOWEST_MM, FEWEST = 0.3, 200
"""A pool is deeper somewhere, and covers more vertices: a pit of the mesh is none."""

LEAST_MM = 1e-3
"""Fluid that is thinner is none."""

LEVELLED_MM = 0.3
"""A layer so thick shows nothing of the relief below it."""

WET_MM = 0.05
"""A layer so thick has a surface of its own."""

ROOM = 1.2
"""A layer needs so many times its thickness above it."""

CROWDED_MM, CROWDED = 0.3, 0.01
"""Wall that has other wall so near above it, in more than this share of the patch, is no single layer."""

CREASE = 0.3
"""A film on both walls of a crease is no thicker than this share of the way between them."""

CLEAR_MM = 0.01
"""Above the mesh, to where a ray leaves it for sure."""

Room = Callable[[np.ndarray, np.ndarray], np.ndarray]

MOST_POINTS = 2000
"""By which the extent of a patch is measured."""


@dataclass(frozen=True, eq=False)
class Puddle:
    """A patch of fluid to be.

    Attributes:
        kind: its name. optics: of the fluid. spread: how it lies: one of ``spread.SPREADS``, or ``pool``.
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
        """Of the mesh that is looked at."""
        return 0.55 * self.size_mm


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
        layer = _layer(puddle, fine, normals, self._room_mm)
        on = layer.thickness_mm[fine.triangles].max(axis=1) > 0
        fault = self._fault(puddle, fine, layer, on)
        if not fault:
            self._lay(puddle, fine, layer, normals, on)
        return fault

    def _room_mm(self, points: np.ndarray, towards: np.ndarray) -> np.ndarray:
        """How far [N] it is from ``points`` of the wall to other wall along ``towards``, [N, 3] each."""
        start = (points + CLEAR_MM * towards).astype(np.float32)
        return self._caster.cast_rays(start, towards.astype(np.float32))[2]

    def _fault(self, puddle: Puddle, fine: Refined, layer: _Layer, on: np.ndarray) -> str:
        if on.sum() < EDGES:
            return "it would run off" if puddle.pool else "the wall there is not whole"
        if self._fluids[fine.origin[on]].any():
            return "another fluid lies there"
        thick = layer.thickness_mm > 0
        room_mm = self._room_mm(fine.rest[thick], layer.towards[thick])
        if (room_mm < CROWDED_MM).mean() > CROWDED:
            return "the wall there lies in layers"
        free = ROOM * layer.thickness_mm[thick] < room_mm
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
        laid = replace(
            surface,
            vertices_mm=kept(surface.vertices_mm, vertices_mm, moves),
            triangles=fine.replaced(surface.triangles, fine.vertices[fine.triangles]).astype(np.int32),
            normals=kept(surface.normals, turned, changed),
            **coverage(surface, weights),
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


def hollows_mm(surface: Surface, down: np.ndarray) -> np.ndarray:
    """How deep fluid may stand on each vertex, float64 [V], before it runs off, gravity being along ``down``
    [3]: to wall that is no floor, or to the edge of the mesh."""
    points = surface.vertices_mm.astype(np.float64)
    graph = spread.edges_of(points, surface.triangles)
    inside = surface.normals @ -down > FLOOR
    ends = np.sort(surface.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges, times = np.unique(ends, axis=0, return_counts=True)
    inside[edges[times == 1]] = False
    height_mm = points @ -down
    return spread.spill_mm(height_mm, inside, graph) - height_mm


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


def _layer(puddle: Puddle, fine: Refined, normals: np.ndarray, room_mm: Room) -> _Layer:
    graph = spread.edges_of(fine.rest, fine.triangles)
    start = int(np.linalg.norm(fine.rest - puddle.start_mm, axis=1).argmin())
    far_mm = spread.along_mesh(graph, start, puddle.reach_mm)
    layer = _standing if puddle.pool else _adhering
    thickness_mm, towards = layer(puddle, fine, normals, room_mm, graph, far_mm)
    thickness_mm[thickness_mm < LEAST_MM] = 0
    return _Layer(thickness_mm, towards)


def _standing(
    puddle: Puddle,
    fine: Refined,
    normals: np.ndarray,
    room_mm: Room,
    graph: scipy.sparse.csr_array,
    far_mm: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Depth [P] of a pool, and its way up, [P, 3]. Where wall hangs over it too low, it runs off."""
    up = np.broadcast_to(-puddle.down, normals.shape)
    inside = (far_mm < puddle.size_mm / 2) & (dot(normals, up) > FLOOR)
    above_mm = np.zeros(len(normals))
    above_mm[inside] = room_mm(fine.rest[inside], up[inside])
    for _ in range(len(normals)):
        depth_mm = spread.pool_mm(dot(fine.rest, up), inside, graph, puddle.thickness_mm)
        low = ROOM * depth_mm > above_mm
        if not low.any():
            break
        inside &= ~low
    holds = depth_mm.max() > SHALLOWEST_MM and np.count_nonzero(depth_mm) > FEWEST
    return depth_mm * holds, up


def _adhering(
    puddle: Puddle,
    fine: Refined,
    normals: np.ndarray,
    room_mm: Room,
    graph: scipy.sparse.csr_array,
    far_mm: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Thickness [P] of what adheres, and the way it rises, [P, 3]."""
    down = puddle.down - dot(puddle.down, normals[far_mm.argmin()]) * normals[far_mm.argmin()]
    found, longest_mm = spread.SPREADS[puddle.spread], spread.LONGEST * puddle.size_mm
    ragged, uneven = (
        spread.noise(longest_mm, finest, unit(down), puddle.generator)(fine.rest)
        for finest in (spread.RAGGEDNESS, found.finest)
    )
    share = found.share(spread.within(far_mm, puddle.size_mm, ragged), uneven)
    if puddle.spread == "lumps":
        axis = unit((share[:, None] * normals).sum(axis=0))
        steep = smoothstep((normals @ axis - 0.2) / 0.4)
        return puddle.thickness_mm * share * steep, np.broadcast_to(axis, normals.shape)
    thickness_mm = puddle.thickness_mm * share
    wet = thickness_mm > 0
    room = room_mm(fine.rest[wet], normals[wet])
    thickness_mm[wet] = np.minimum(thickness_mm[wet], CREASE * room)
    return thickness_mm, normals


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

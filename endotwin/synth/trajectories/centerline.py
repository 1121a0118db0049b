"""The centreline of the lumen, found from the mesh alone: open ends, holes and folds allowed.

Chords along the wall's normals have their midpoints near the axis. The path through those midpoints that
stays where the lumen is wide (least ∫ ds/r², after Antiga et al. 2003, who use Voronoi vertices) is a
rough centreline. It is then recentred: rays perpendicular to it meet the wall, a circle by what they meet
gives the new centre, and a smoothing spline the new line.
"""

from __future__ import annotations

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from scipy.interpolate import BSpline, make_smoothing_spline
from scipy.ndimage import binary_closing
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from endotwin.errors import TrajectoryError
from endotwin.surface import Surface
from endotwin.surface.vectors import frame_along, unit
from endotwin.synth.trajectories.lumen import Lumen

CHORDS = 4000
NEIGHBOURS = 16
RECENTRINGS = 8
SPOKES = 72

WALL_MIN = 0.5
"""Least share of perpendicular rays that must meet the photographed wall for a circle to count."""

ENDS_MIN = 0.75
"""The same at the line's ends (or the median share, where that is less): nothing past them corrects them."""

STEPS = 8
"""Stations a radius."""

SPACING_MM = 0.5
"""Between the points of the line that is found."""

GAP = 9
"""Stations that may lack a wall within the line, less one: about a radius, the blind side of a fold."""

CIRCLE_ROUNDS = 3
"""Fits of a circle; after each, points half a radius off it are left out as wall seen through a gap."""

REACH = 3.0
"""Wall farther from the line than this many median radii belongs to another part of the lumen."""

SMOOTHING = 3.0
"""Wavelength, in median radii, that the smoothing spline halves: bends stay, folds go."""


@dataclass(frozen=True)
class Centerline:
    """A smooth line through the lumen.

    Attributes:
        points_mm: float64 [N, 3], world, evenly spaced along the line.
        radius_mm: float64 [N], of the circle through the wall about each point.
    """

    points_mm: np.ndarray
    radius_mm: np.ndarray

    @property
    def length_mm(self) -> float:
        return float(arc_length(self.points_mm)[-1])

    @property
    def spacing_mm(self) -> float:
        return self.length_mm / (len(self.points_mm) - 1)


def find_centerline(lumen: Lumen) -> Centerline:
    """The centreline of the part of the lumen whose wall was photographed (of all of it, if nothing was).

    It runs the way the training cameras looked: towards the wall that they only saw from afar.

    Raises:
        TrajectoryError: the mesh encloses no lumen that a line could follow.
    """
    surface = lumen.surface
    if surface not in _found:
        _found[surface] = _sought(lumen)
    return _found[surface]


_found: WeakKeyDictionary[Surface, Centerline] = WeakKeyDictionary()
"""A trajectory and a motion ask for the line of the same surface."""


def _sought(lumen: Lumen) -> Centerline:
    surface = lumen.surface
    covered = _covered(surface)
    line = _rough_line(lumen, covered)
    if line is None:
        raise TrajectoryError(
            "no centreline: the mesh has too few facing walls; give a pose file or 'jitter:'"
        )
    for _ in range(RECENTRINGS):
        stations, radius_mm, share = _recentred(lumen, covered, line)
        if len(stations) < 5:
            raise TrajectoryError(
                "no centreline: the wall is open on most sides of it; give a pose file or 'jitter:'"
            )
        line = _smooth(stations, float(np.median(radius_mm)), share**2)
    arc = arc_length(line)
    even = np.linspace(0, arc[-1], max(int(arc[-1] / SPACING_MM) + 1, 5))
    points = np.stack([np.interp(even, arc, axis) for axis in line.T], axis=1)
    radius_mm = np.interp(even / even[-1], np.linspace(0, 1, len(radius_mm)), radius_mm)
    if _looks_backward(surface, points):
        points, radius_mm = points[::-1], radius_mm[::-1]
    return Centerline(points + surface.origin_mm, radius_mm)


def arc_length(points: np.ndarray) -> np.ndarray:
    """Length [N] of the polyline [N, 3] up to each point."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def _covered(surface: Surface) -> np.ndarray:
    """Bool [F]: photographed triangles; all of them where coverage is unknown."""
    seen = (surface.seen_by > 0) & ~surface.filled
    if not seen.any():
        return np.ones(len(surface.triangles), bool)
    return seen[surface.triangles].all(axis=1)


def _rough_line(lumen: Lumen, covered: np.ndarray) -> np.ndarray | None:
    """The widest long path through midpoints of chords, local frame [N, 3]; None where there is none."""
    surface = lumen.surface
    candidates = np.flatnonzero(covered)
    feet = candidates[np.linspace(0, len(candidates) - 1, min(CHORDS, len(candidates))).astype(int)]
    starts = surface.vertices_mm[surface.triangles[feet]].mean(axis=1).astype(np.float64)
    inward = unit(surface.normals[surface.triangles[feet]].mean(axis=1).astype(np.float64))
    starts += 1e-3 * inward
    distance_mm, triangle, front = (a[:, 0] for a in lumen.probe(starts, inward[:, None]))
    chord = front & covered[triangle]
    points = starts[chord] + 0.5 * distance_mm[chord, None] * inward[chord]
    if len(points) < NEIGHBOURS + 1:
        return None
    clearance = cKDTree(surface.vertices_mm).query(points, workers=-1)[0]
    cells = np.floor(points / (0.1 * np.median(clearance))).astype(np.int64)
    one_a_cell = np.unique(cells, axis=0, return_index=True)[1]
    wide = one_a_cell[clearance[one_a_cell] > 0.5 * np.median(clearance)]
    points, clearance = points[wide], clearance[wide]
    if len(points) < 5:
        return None
    path = _widest_path(points, clearance)
    if len(path) < 5:
        return None
    return _smooth(points[path], float(np.median(clearance[path])), np.ones(len(path)))


def _widest_path(points: np.ndarray, clearance: np.ndarray) -> np.ndarray:
    """Indices of the path of least ∫ ds/r² between the points [N, 3] farthest apart within the lumen."""
    count = min(NEIGHBOURS, len(points) - 1)
    length, other = cKDTree(points).query(points, k=count + 1)
    one = np.repeat(np.arange(len(points)), count)
    length, other = length[:, 1:].ravel(), other[:, 1:].ravel()
    joined = (length < clearance[one] + clearance[other]) & (length > 0)
    one, other, length = one[joined], other[joined], length[joined]
    shape = (len(points), len(points))
    graph = coo_array((length, (one, other)), shape=shape).tocsr()
    labels = connected_components(graph, directed=False)[1]
    largest = np.flatnonzero(labels == np.bincount(labels).argmax())
    start = _farthest(graph, _farthest(graph, int(largest[0])))
    end = _farthest(graph, start)
    costs = length / (0.5 * (clearance[one] + clearance[other])) ** 2
    costs_graph = coo_array((costs, (one, other)), shape=shape).tocsr()
    previous = dijkstra(costs_graph, directed=False, indices=start, return_predecessors=True)[1]
    path = [end]
    while path[-1] != start:
        path.append(int(previous[path[-1]]))
    return np.array(path[::-1])


def _farthest(graph: coo_array, start: int) -> int:
    distance = dijkstra(graph, directed=False, indices=start)
    return int(np.where(np.isfinite(distance), distance, -1).argmax())


def _recentred(
    lumen: Lumen, covered: np.ndarray, line: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Circles about a line, first lengthened by a radius at both ends: where the wall stands around it.

    Returns:
        centres [N, 3], radii [N], and the share [N] of directions in which there is wall.
    """
    about_mm = _radius_about(lumen, line)
    line = lengthened(line, about_mm, about_mm)
    arc = arc_length(line)
    even = np.linspace(0, arc[-1], max(int(arc[-1] * STEPS / about_mm), 20))
    stations = np.stack([np.interp(even, arc, axis) for axis in line.T], axis=1)
    tangents = unit(np.gradient(stations, axis=0))
    spokes, u, v = _spokes(tangents)
    distance_mm, triangle, front = lumen.probe(stations, spokes)
    wall = front & covered[triangle] & (distance_mm < REACH * about_mm)
    x = np.where(wall, distance_mm, 0) * np.cos(_angles())
    y = np.where(wall, distance_mm, 0) * np.sin(_angles())
    circles = [_circle(x[k, wall[k]], y[k, wall[k]]) for k in range(len(stations))]
    share = wall.mean(axis=1)
    supported = (share >= WALL_MIN) & np.isfinite(circles).all(axis=1)
    first, last = longest_run(binary_closing(supported, np.ones(GAP)) | supported)
    kept = np.flatnonzero(supported[first:last]) + first
    if len(kept):
        strong = np.flatnonzero(share[kept] >= min(ENDS_MIN, np.median(share[kept])))
        kept = kept[strong[0] : strong[-1] + 1]
    a, b, radius_mm = np.array(circles)[kept].T
    return stations[kept] + a[:, None] * u[kept] + b[:, None] * v[kept], radius_mm, share[kept]


def _radius_about(lumen: Lumen, line: np.ndarray) -> float:
    """Median distance of the wall perpendicular to the line, mm."""
    spokes, _, _ = _spokes(unit(np.gradient(line, axis=0)))
    distance_mm, _, front = lumen.probe(line, spokes)
    if not front.any():
        raise TrajectoryError(
            "no centreline: no wall stands around it; give a pose file or 'jitter:' instead"
        )
    return float(np.median(distance_mm[front]))


def _angles() -> np.ndarray:
    return np.arange(SPOKES) * (2 * np.pi / SPOKES)


def _spokes(tangents: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions [N, SPOKES, 3] across unit tangents [N, 3], and the axes u, v [N, 3] that they turn in."""
    u, v, _ = np.moveaxis(frame_along(tangents), 1, 0)
    angles = _angles()[None, :, None]
    return np.cos(angles) * u[:, None] + np.sin(angles) * v[:, None], u, v


def _circle(x: np.ndarray, y: np.ndarray) -> tuple[float, float, float]:
    """Centre and radius of a circle by points [N], least squares of x² + y² = 2ax + 2by + c (Kåsa 1976)."""
    circle = (np.nan, np.nan, np.nan)
    for _ in range(CIRCLE_ROUNDS):
        if len(x) < 3:
            return circle
        a, b, c = np.linalg.lstsq(
            np.stack([2 * x, 2 * y, np.ones_like(x)], axis=1), x * x + y * y, rcond=None
        )[0]
        radius = np.sqrt(max(c + a * a + b * b, 0))
        circle = (float(a), float(b), float(radius))
        near = np.abs(np.hypot(x - a, y - b) - radius) < 0.5 * radius
        x, y = x[near], y[near]
    return circle


def lengthened(line: np.ndarray, before_mm: float, after_mm: float) -> np.ndarray:
    """The line [N, 3] with a straight piece added before and after it."""
    behind = line[0] + before_mm * unit(line[0] - line[min(STEPS, len(line) - 1)])
    ahead = line[-1] + after_mm * unit(line[-1] - line[max(-STEPS - 1, -len(line))])
    return np.vstack([behind, line, ahead])


def longest_run(flags: np.ndarray) -> tuple[int, int]:
    """First index and end of the longest run of true in ``flags`` [N]; (0, 0) where there is none."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    starts, ends = edges[::2], edges[1::2]
    if len(starts) == 0:
        return 0, 0
    longest = (ends - starts).argmax()
    return int(starts[longest]), int(ends[longest])


def _smooth(stations: np.ndarray, radius_mm: float, weights: np.ndarray) -> np.ndarray:
    """The smoothing spline through stations [N, 3] of ``weights`` [N], sampled at as many points.

    With penalty λ and points h apart, a cubic smoothing spline passes 1/(1 + λh(2π/L)⁴) of wavelength L.
    """
    arc = arc_length(stations)
    spacing = arc[-1] / (len(arc) - 1)
    penalty = (SMOOTHING * radius_mm / (2 * np.pi)) ** 4 / spacing
    spline: BSpline = make_smoothing_spline(arc, stations, weights, lam=penalty)
    return spline(np.linspace(0, arc[-1], len(arc)))


def _looks_backward(surface: Surface, points: np.ndarray) -> bool:
    """Whether the line [N, 3] runs from the wall seen from afar to the wall seen from near."""
    seen = np.flatnonzero(np.isfinite(surface.nearest_mm))
    if len(seen) == 0:
        return False
    nearest_point = cKDTree(points).query(surface.vertices_mm[seen])[1]
    return np.cov(nearest_point, surface.nearest_mm[seen])[0, 1] < 0

"""What is to be on the wall, and its places: given ones, or drawn where a trajectory sees them well."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from endotwin.cameras import Camera
from endotwin.errors import OptionError
from endotwin.run.arguments import texts
from endotwin.sequence.spread import spread
from endotwin.surface import Surface
from endotwin.surface.casting import Caster
from endotwin.surface.vectors import dot, unit
from endotwin.synth.trajectories import Trajectory
from endotwin.synth.trajectories.wall_point import WallPoint, wall_point
from endotwin.twin import Twin

VIEWS, GRID = 48, 40
"""Poses of a trajectory whose view is searched for places, and pixels of a view across and down."""

FACING = 0.35
"""Least cosine between the wall's normal and the ray to it, of a place drawn by chance."""

FARTHEST_MM = 60.0
"""Of a place drawn by chance, from a pose that sees it."""

OFF_MM = 2.0
"""A point that is given lies on the wall if it is no farther from it."""


@dataclass(frozen=True)
class Several(WallPoint):
    """Options of one or several things of a kind on the wall."""

    count: int = field(default=1, metadata={"help": "number of such"})

    def require_count(self, what: str) -> None:
        """Raises OptionError where none is asked for, or several at one place."""
        if self.count < 1 or (self.placed and self.count > 1):
            raise OptionError(f"{what}: count is at least 1, and 1 where a place is given")


Asked = tuple[str, str, Several]


def one_by_one(
    twin: Twin,
    specs: Iterable[str] | str,
    parse: Callable[[str], tuple[str, Several]],
    room: int,
    full: str,
    name: str,
) -> list[Asked]:
    """The spec, the kind and the options of each thing that ``specs`` ask for, as ``parse`` tells them;
    ``name``: what the specs are called.

    Raises:
        TwinError: the twin is not fitted. OptionError: there are more than ``room``, with the text ``full``.
    """
    twin.require_fitted()
    asked = [(spec, *parse(spec)) for spec in texts(name, specs)]
    if sum(options.count for *_, options in asked) > room:
        raise OptionError(full)
    return [one for one in asked for _ in range(one[2].count)]


class Wall:
    """The wall of one twin.

    Args:
        trajectory: that sees the places; None: wherever training photos saw the wall. camera: that it looks
            through.
    """

    def __init__(self, twin: Twin, trajectory: Trajectory | None, camera: Camera, caster: Caster):
        self._twin, self._trajectory, self._camera, self._caster = twin, trajectory, camera, caster

    def places(
        self, what: str, options: WallPoint, generator: np.random.Generator
    ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Points [3] of the wall, in the surface's frame, and its normals [3], for the options of ``what``;
        raises OptionError where a given one is not on the wall."""
        surface = self._twin.surface
        if options.placed:
            point = wall_point(options, self._twin, what, OptionError) - surface.origin_mm
            off_mm, nearest = cKDTree(surface.vertices_mm).query(point)
            if off_mm > OFF_MM:
                raise OptionError(
                    f"{what}: its place is {off_mm:.1f} mm from the surface; give a point of the wall"
                )
            yield surface.vertices_mm[nearest].astype(np.float64), surface.normals[nearest]
            return
        points, normals = self._seen
        for k in generator.permutation(len(points)):
            yield points[k], normals[k]

    @cached_property
    def _seen(self) -> tuple[np.ndarray, np.ndarray]:
        """Points [N, 3] of the wall that may be chosen, and normals [N, 3]."""
        surface = self._twin.surface
        if self._trajectory is None:
            seen = np.flatnonzero((surface.seen_by > 0) & ~surface.filled)
            return surface.vertices_mm[seen].astype(np.float64), surface.normals[seen]
        poses = self._trajectory.T_world_camera[spread(len(self._trajectory), VIEWS)]
        views = [_seen_from(pose, surface, self._camera, self._caster) for pose in poses]
        return tuple(np.concatenate(each) for each in zip(*views, strict=True))


def _seen_from(
    T_world_camera: np.ndarray, surface: Surface, camera: Camera, caster: Caster
) -> tuple[np.ndarray, np.ndarray]:
    """Points [N, 3] of well seen wall in one view, and normals [N, 3]."""
    mask = np.zeros((camera.height, camera.width), bool)
    down, across = (np.linspace(0, size - 1, GRID).astype(int) for size in mask.shape)
    mask[np.ix_(down, across)] = True
    hits = caster.cast(camera, T_world_camera, mask)
    corners = surface.triangles[hits.triangle]
    measured = (surface.seen_by[corners] > 0).all(axis=1) & ~surface.filled[corners].any(axis=1)
    points = hits.interpolate(surface, surface.vertices_mm.astype(np.float64))
    normals = unit(hits.interpolate(surface, surface.normals))
    rays = unit(points - surface.to_local(T_world_camera)[:3, 3])
    chosen = measured & (dot(rays, normals) < -FACING) & (hits.distance_mm < FARTHEST_MM)
    return points[chosen], normals[chosen]

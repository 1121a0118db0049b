"""An orbit about a point of the wall, such as a polyp."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import isnan, nan
from typing import Protocol

import numpy as np
from scipy.spatial import cKDTree

from endotwin.errors import EndotwinError, TrajectoryError
from endotwin.surface.casting import Caster, surface_points
from endotwin.surface.vectors import unit
from endotwin.synth.trajectories.flight import posed, untwisted
from endotwin.twin import Twin


@dataclass(frozen=True)
class OrbitOptions:
    """Options of ``orbit:``, a circle about the wall's normal at a point, looking at the point."""

    x: float = field(default=nan, metadata={"help": "the point, world mm", "signed": True})
    y: float = field(default=nan, metadata={"help": "the point, world mm", "signed": True})
    z: float = field(default=nan, metadata={"help": "the point, world mm", "signed": True})
    frame: int = field(default=0, metadata={"help": "or the point at pixel u, v of this frame"})
    u: float = field(default=nan, metadata={"help": "pixel, to the right"})
    v: float = field(default=nan, metadata={"help": "pixel, down"})
    radius: float = field(default=10.0, metadata={"help": "distance from the point, mm"})
    tilt: float = field(default=30.0, metadata={"help": "angle between view and the wall's normal, degrees"})
    frames: int = field(default=60, metadata={"help": "number of poses, once round"})


def orbit(options: OrbitOptions, twin: Twin) -> tuple[np.ndarray, str]:
    """Poses ``T_world_camera`` float64 [N, 4, 4] on the circle, and its description.

    Raises:
        TrajectoryError: no point is given, or there is none at that pixel. SequenceError: the sequence of
            ``frame`` is gone.
    """
    point = wall_point(options, twin, "orbit", TrajectoryError)
    surface = twin.surface
    nearest = cKDTree(surface.vertices_mm).query(point - surface.origin_mm)[1]
    normal = surface.normals[nearest].astype(np.float64)
    side = unit(np.cross(normal, np.eye(3)[np.abs(normal).argmin()]))
    angle = np.arange(options.frames) * 2 * np.pi / max(options.frames, 1)
    tilt = np.deg2rad(options.tilt)
    around = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * np.cross(normal, side)
    away = np.cos(tilt) * normal + np.sin(tilt) * around
    places = point + options.radius * away
    where = ", ".join(f"{value:.2f}" for value in point)
    description = f"an orbit at {options.radius:g} mm and {options.tilt:g}° about the point ({where}) mm"
    return posed(untwisted(places, -away), places), description


class Point(Protocol):
    """Options that tell a point of the wall: where it lies, or the pixel of a frame that shows it."""

    x: float
    y: float
    z: float
    frame: int
    u: float
    v: float


def wall_point(options: Point, twin: Twin, what: str, error: type[EndotwinError]) -> np.ndarray:
    """The point of the options of ``what``, float64 [3], world mm.

    Raises:
        error: none is given, or there is none at that pixel. SequenceError: the sequence is gone.
    """
    given = np.array([options.x, options.y, options.z])
    if not np.isnan(given).any():
        return given
    if isnan(options.u) or isnan(options.v):
        raise error(f"{what} needs its point: give x, y and z, or frame, u and v")
    poses, camera = twin.sequence().T_world_camera, twin.camera
    if options.frame >= len(poses):
        raise error(f"{what}: there is no frame {options.frame}; the sequence has {len(poses)}")
    mask = np.zeros((camera.height, camera.width), bool)
    column, row = round(options.u), round(options.v)
    if column >= camera.width or row >= camera.height:
        raise error(
            f"{what}: pixel {column}, {row} is outside of {camera.width}×{camera.height}; choose another"
        )
    mask[row, column] = True
    hits = Caster(twin.surface, threads=1).cast(camera, poses[options.frame], mask)
    if not len(hits):
        raise error(f"{what}: pixel {column}, {row} of frame {options.frame} sees no surface; choose another")
    return surface_points(twin.surface, hits)[0]

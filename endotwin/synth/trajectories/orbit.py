"""An orbit about a point of the wall, such as a polyp."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from endotwin.errors import TrajectoryError
from endotwin.surface.vectors import frame_along
from endotwin.synth.trajectories.flight import posed, untwisted
from endotwin.synth.trajectories.wall_point import WallPoint, wall_point
from endotwin.twin import Twin


@dataclass(frozen=True)
class OrbitOptions(WallPoint):
    """Options of ``orbit:``, a circle about the wall's normal at a point, looking at the point."""

    radius: float = field(default=10.0, metadata={"help": "distance from the point, mm"})
    tilt: float = field(default=30.0, metadata={"help": "angle between view and the wall's normal, degrees"})
    frames: int = field(default=60, metadata={"help": "number of poses, once round"})


def orbit(options: OrbitOptions, twin: Twin) -> tuple[np.ndarray, str]:
    """Poses ``T_world_camera`` float64 [N, 4, 4] on the circle, and its description.

    Raises:
        TrajectoryError: no frames, or no point is given, or there is none at that pixel. SequenceError: the
            sequence of ``frame`` is gone.
    """
    if not options.frames:
        raise TrajectoryError("an orbit of 0 frames has no pose; ask for some")
    point = wall_point(options, twin, "orbit", TrajectoryError)
    surface = twin.surface
    nearest = cKDTree(surface.vertices_mm).query(point - surface.origin_mm)[1]
    normal = surface.normals[nearest].astype(np.float64)
    side, beside, _ = frame_along(normal)
    angle = np.arange(options.frames) * 2 * np.pi / options.frames
    tilt = np.deg2rad(options.tilt)
    around = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * beside
    away = np.cos(tilt) * normal + np.sin(tilt) * around
    places = point + options.radius * away
    where = ", ".join(f"{value:.2f}" for value in point)
    description = f"an orbit at {options.radius:g} mm and {options.tilt:g}° about the point ({where}) mm"
    return posed(untwisted(places, -away), places), description

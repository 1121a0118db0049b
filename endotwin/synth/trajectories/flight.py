"""A fly-through of the lumen along its centreline."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from endotwin.cameras import Camera
from endotwin.errors import TrajectoryError
from endotwin.run.streams import Stream
from endotwin.surface.vectors import unit
from endotwin.synth.trajectories.centerline import Centerline, arc_length, find_centerline, longest_run
from endotwin.synth.trajectories.lumen import Lumen

FRONT_MIN = 0.5
"""Least share of the straight-ahead view that meets the wall, anywhere on the flight."""

SPEED_MM = 0.5

SWAY_MM = (23.0, 37.0)
"""Path lengths of one sway of the look-around, sideways and up and down; unlike, so the view wanders."""


@dataclass(frozen=True)
class FlightOptions:
    """Options of ``centerline:``, a fly-through in the direction that the training cameras looked."""

    frames: int = field(default=0, metadata={"help": "number of poses; 0: as many as fit at that speed"})
    speed: float = field(
        default=0.0,
        metadata={"help": f"mm a frame; 0: even over all of the line, or {SPEED_MM:g} without frames"},
    )
    look: float = field(default=0.0, metadata={"help": "largest angle between view and line, degrees"})
    reverse: bool = field(default=False, metadata={"help": "true: withdrawal, backwards while looking ahead"})


def fly(
    options: FlightOptions, lumen: Lumen, camera: Camera, seed: int, clearance_mm: float = 1.0
) -> tuple[np.ndarray, str]:
    """Poses ``T_world_camera`` float64 [N, 4, 4] of a flight along the lumen, and its description.

    The camera looks along the centreline; its up direction is carried along without twist. ``seed`` chooses
    where the sway of ``look`` begins. It keeps to the part of the line that has ``clearance_mm`` about it.

    Raises:
        TrajectoryError: there is no centreline, or it is too short for ``frames`` at ``speed``.
    """
    line = _approached(find_centerline(lumen))
    ahead = unit(np.gradient(line, axis=0))
    outlook = lumen.outlook(camera, posed(untwisted(line, ahead), line))
    clear = outlook.inside & (outlook.clearance_mm >= clearance_mm)
    first, last = longest_run(clear & (outlook.front >= FRONT_MIN))
    if last - first < 2:
        raise TrajectoryError(
            "no place on the centreline shows enough of the wall to fly there; give a pose file or 'jitter:'"
        )
    arc = arc_length(line)
    at_mm = arc[first] + stops(options.frames, options.speed, arc[last - 1] - arc[first])
    points = CubicSpline(arc, line)(at_mm)
    tangents = unit(CubicSpline(arc, ahead)(at_mm))
    rotations = untwisted(points, tangents) @ _sway(at_mm - at_mm[0], options.look, seed)
    poses = posed(rotations, points)
    length_mm = at_mm[-1] - at_mm[0]
    description = (
        f"{'withdrawal' if options.reverse else 'fly-through'} of {length_mm:.2f} mm along the centreline"
    )
    if options.look:
        description += f", looking around by up to {options.look:g}°"
    return poses[::-1].copy() if options.reverse else poses, description


def _approached(centerline: Centerline) -> np.ndarray:
    """The centreline's points [N, 3] after a straight approach of one radius.

    A camera that looks ahead sees no wall beside its first places, so the centreline begins ahead of them.
    """
    points = centerline.points_mm
    count = max(int(np.median(centerline.radius_mm) / centerline.spacing_mm), 1)
    step = points[0] - points[1]
    return np.vstack([points[0] + step * np.arange(count, 0, -1)[:, None], points])


def untwisted(points: np.ndarray, tangents: np.ndarray) -> np.ndarray:
    """Camera-to-world rotations [N, 3, 3] along unit tangents [N, 3] at points [N, 3], without twist.

    Rotation-minimising frames by double reflection (Wang et al. 2008). The first has y (down) as near as can
    be to the world axis that is most across the line.
    """
    down = np.eye(3)[np.abs(tangents[0]).argmin()]
    down = unit(down - tangents[0] * (down @ tangents[0]))
    downs = [down]
    for step, tangent, ahead in zip(np.diff(points, axis=0), tangents[:-1], tangents[1:], strict=True):
        down, tangent = _reflected(down, step), _reflected(tangent, step)
        down = _reflected(down, ahead - tangent)
        downs.append(unit(down - ahead * (down @ ahead)))
    y = np.array(downs)
    return np.stack([np.cross(y, tangents), y, tangents], axis=2)


def _reflected(vector: np.ndarray, across: np.ndarray) -> np.ndarray:
    """The vector mirrored in the plane whose normal is ``across`` (any length; zero mirrors nothing)."""
    squared = across @ across
    return vector if squared < 1e-24 else vector - across * (2 * (across @ vector) / squared)


def posed(rotations: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Poses [N, 4, 4] of camera-to-world rotations [N, 3, 3] at points [N, 3]."""
    poses = np.tile(np.eye(4), (len(points), 1, 1))
    poses[:, :3, :3] = rotations
    poses[:, :3, 3] = points
    return poses


MOST_FRAMES = 100_000
"""Poses are kept in memory; more frames are made as several datasets, each with a seed of its own."""


def stops(frames: int, speed: float, length_mm: float) -> np.ndarray:
    """Where on a path of ``length_mm`` the poses are, mm from its start, float64 [N].

    ``frames`` poses ``speed`` mm apart; 0 frames: as many as fit; speed 0: even over the whole path, or
    SPEED_MM without frames. Raises TrajectoryError where the path is too short.
    """
    if frames and not speed:
        return np.linspace(0, length_mm, frames)
    speed = speed or SPEED_MM
    fits = int(min(length_mm / speed * (1 + 1e-12), MOST_FRAMES)) + 1
    if not frames and fits > MOST_FRAMES:
        raise TrajectoryError(
            f"a camera at {speed:g} mm a frame needs more than {MOST_FRAMES} frames for {length_mm:.1f} mm; "
            "raise its speed"
        )
    if frames > fits:
        raise TrajectoryError(
            f"{frames} frames at {speed:g} mm a frame need more than the {length_mm:.1f} mm that the path "
            f"has; "
            f"use at most {fits} frames or a lower speed"
        )
    return speed * np.arange(frames or fits)


def _sway(at_mm: np.ndarray, look_degrees: float, seed: int) -> np.ndarray:
    """Rotations [N, 3, 3] in the camera frame that sway the view by up to ``look_degrees`` along the path."""
    phase = 2 * np.pi * Stream.SWAY.generator(seed).random(2)
    swing = np.sin(2 * np.pi * at_mm[:, None] / np.array(SWAY_MM) + phase) / np.sqrt(2)
    turn = np.zeros((len(at_mm), 3))
    turn[:, 1], turn[:, 0] = swing.T
    return Rotation.from_rotvec(np.deg2rad(look_degrees) * turn).as_matrix()

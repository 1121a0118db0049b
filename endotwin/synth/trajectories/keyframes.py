"""A smooth path through keyframes."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from endotwin.errors import TrajectoryError
from endotwin.sequence.poses import read_poses
from endotwin.synth.trajectories.flight import SPEED_MM, posed, stops

TURN_MM = 5.0
"""Length of a turn by 1 rad, so that a path through keyframes of one place has a length too."""

SAMPLES = 50
"""Samples of the path between two keyframes, to measure its length."""


@dataclass(frozen=True)
class SplineOptions:
    """Options of ``spline:FILE``, a path through the poses in a file."""

    frames: int = field(default=0, metadata={"help": "number of poses; 0: as many as fit at that speed"})
    speed: float = field(
        default=0.0,
        metadata={
            "help": f"mm a frame, a turn by 1 rad counting {TURN_MM:g} mm; 0: even over all of the path, or "
            f"{SPEED_MM:g} without frames"
        },
    )


def spline_through(options: SplineOptions, file: Path) -> tuple[np.ndarray, str]:
    """Poses ``T_world_camera`` float64 [N, 4, 4] along a path through the keyframes in ``file``, and its
    description.

    Places follow a natural cubic spline and rotations one of continuous angular acceleration, over a common
    parameter; poses are spaced evenly along the path.

    Raises:
        TrajectoryError: the file has fewer than two different keyframes, or the path is too short for
            ``frames`` at ``speed``.
    """
    keyframes, _ = read_poses(file)
    steps = _lengths(keyframes)
    keyframes = keyframes[np.concatenate([[True], steps > 1e-9])]
    if len(keyframes) < 2:
        raise TrajectoryError(f"{file} has fewer than two different keyframes; save more of them")
    knots = np.concatenate([[0.0], np.cumsum(_lengths(keyframes))])
    places = CubicSpline(knots, keyframes[:, :3, 3], bc_type="natural")
    rotations = RotationSpline(knots, Rotation.from_matrix(keyframes[:, :3, :3]))

    def path(at: np.ndarray) -> np.ndarray:
        return posed(rotations(at).as_matrix(), places(at))

    fine = np.linspace(0, knots[-1], SAMPLES * (len(knots) - 1) + 1)
    arc = np.concatenate([[0.0], np.cumsum(_lengths(path(fine)))])
    at_mm = stops(options.frames, options.speed, arc[-1])
    poses = path(np.interp(at_mm, arc, fine))
    return poses, f"a spline of {arc[-1]:.2f} mm through the {len(keyframes)} keyframes of {file.name}"


def _lengths(poses: np.ndarray) -> np.ndarray:
    """Lengths [N − 1] of the steps between poses [N, 4, 4], moves and turns together."""
    moves_mm = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    relative = poses[:-1, :3, :3].transpose(0, 2, 1) @ poses[1:, :3, :3]
    turns = Rotation.from_matrix(relative).magnitude() if len(relative) else np.zeros(0)
    return np.hypot(moves_mm, TURN_MM * turns)

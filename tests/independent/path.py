"""Where the camera goes: forward, back, along the wall, or in a helix."""

from __future__ import annotations

import numpy as np

from independent.colon import Colon

KINDS = ("forward", "withdrawal", "wall", "helix")


def fly(rng: np.random.Generator, colon: Colon, kind: str, count: int) -> np.ndarray:
    """Poses camera to world, float64 [count, 4, 4], about the middle of the colon's length.

    The step is a few percent of the radius, the camera at most 0.25 radii off the centreline, and its roll
    drifts.
    """
    t = np.linspace(0, 1, count)
    travel_mm = rng.uniform(0.025, 0.06) * colon.radius_mm * count
    middle_mm = colon.line.s_mm[-1] * rng.uniform(0.42, 0.52)
    s_mm = middle_mm + travel_mm * (t - 0.5) * (-1 if kind == "withdrawal" else 1)
    phase, aside, turns = rng.uniform([0, 0.08, 0.2], [2 * np.pi, 0.25, 0.6])
    turns = 1.0 if kind == "helix" else turns
    angle = phase + 2 * np.pi * turns * t
    tilt = np.radians(
        {"wall": rng.uniform(35, 60), "helix": rng.uniform(12, 25)}.get(kind, rng.uniform(4, 14))
    )
    heading = angle + np.pi if kind == "helix" else rng.uniform(0, 2 * np.pi) + rng.uniform(0.3, 1.2) * t
    roll = rng.uniform(0, 2 * np.pi) + rng.uniform(-0.3, 0.3) * t
    centre, axes = colon.line.at(s_mm)
    poses = np.tile(np.eye(4), (count, 1, 1))
    beside = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1) * aside * colon.radius_mm
    poses[:, :3, 3] = centre + np.einsum("nij,nj->ni", axes, beside)
    poses[:, :3, :3] = axes @ _rotation(heading, np.full(count, tilt), roll)
    return poses


def _rotation(heading: np.ndarray, tilt: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """Rotations [N, 3, 3]: z tilted by ``tilt`` towards the angle ``heading``, then rolled about itself."""

    def about_z(angle: np.ndarray) -> np.ndarray:
        cos, sin, one = np.cos(angle), np.sin(angle), np.ones_like(angle)
        rows = [[cos, -sin, 0 * one], [sin, cos, 0 * one], [0 * one, 0 * one, one]]
        return np.moveaxis(np.array(rows), -1, 0)

    cos, sin, zero = np.cos(tilt), np.sin(tilt), 0 * tilt
    tilted = np.moveaxis(np.array([[cos, zero, sin], [zero, 1 + zero, zero], [-sin, zero, cos]]), -1, 0)
    return about_z(heading) @ tilted @ about_z(roll)

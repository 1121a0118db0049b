"""Small motions of cameras: T·exp(ξ), with ξ the exponential coordinates of SciPy's RigidTransform: a
rotation vector in radians, then a translation in mm, both in the camera's frame."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import RigidTransform, Rotation

CITTERT = 6
"""Rounds in which turns between frames are undone."""


def moved(T: np.ndarray, twists: np.ndarray) -> np.ndarray:
    """Poses [..., 4, 4] times exp(``twists``) [..., 6], float64."""
    flat = np.broadcast_to(twists, (*np.shape(T)[:-2], 6)).reshape(-1, 6).copy()
    return T @ RigidTransform.from_exp_coords(flat).as_matrix().reshape(np.shape(T))


def twists_between(T: np.ndarray, T_other: np.ndarray) -> np.ndarray:
    """ξ float64 [N, 6] such that ``T``·exp(ξ) is ``T_other``, both [N, 4, 4]."""
    return RigidTransform.from_matrix(np.linalg.inv(T) @ T_other).as_exp_coords()


def adjoint(T: np.ndarray) -> np.ndarray:
    """[N, 6, 6] of poses [N, 4, 4]: T·exp(ξ)·T⁻¹ = exp(Ad ξ)."""
    R, t = T[:, :3, :3], T[:, :3, 3]
    found = np.zeros((len(T), 6, 6))
    found[:, :3, :3] = found[:, 3:, 3:] = R
    found[:, 3:, :3] = np.cross(t[:, :, None], R, axis=1)
    return found


class Path:
    """The path that written poses [N, 4, 4] tell of, at the times 0, 1, …; beyond its ends it goes on as
    there."""

    def __init__(self, T_world_camera: np.ndarray):
        self.T_world_camera = T_world_camera
        times = np.arange(len(T_world_camera))
        if len(times) > 1:
            self._places = CubicSpline(times, T_world_camera[:, :3, 3])

    def later(self, lag: float) -> np.ndarray:
        """The poses [N, 4, 4] of ``lag`` frames later: those that a clock off by as much would have written
        so.

        Places lie on a spline. A hand's turns shake from frame to frame, and a spline through what was read
        between two frames smooths them twice: those are sought that give the written ones where a recorder
        goes straight from one to the next (Van Cittert 1931).
        """
        written = self.T_world_camera.copy()
        if lag == 0 or len(written) < 2:
            return written
        times, last = np.arange(len(written)), len(written) - 1
        inside = np.clip(times + lag, 0, last)
        beyond = (times + lag - inside)[:, None] * self._places(inside, 1)
        T = written.copy()
        T[:, :3, 3] = self._places(inside) + beyond
        read = Rotation.from_matrix(written[:, :3, :3])
        turns = _turned(read, lag)
        known = np.flatnonzero((times - lag >= 0) & (times - lag <= last))
        for _ in range(CITTERT):
            turns[known] = turns[known] * _turned(turns, -lag)[known].inv() * read[known]
        T[:, :3, :3] = turns.as_matrix()
        return T


def _turned(turns: Rotation, lag: float) -> Rotation:
    """``turns`` of N frames, ``lag`` frames later, going straight from one to the next."""
    times = np.arange(len(turns)) + lag
    before = np.clip(np.floor(times).astype(int), 0, len(turns) - 2)
    step = (turns[before].inv() * turns[before + 1]).as_rotvec()
    return turns[before] * Rotation.from_rotvec(step * (times - before)[:, None])

"""Small motions of cameras: T·exp(ξ), with ξ the exponential coordinates of SciPy's RigidTransform: a
rotation vector in radians, then a translation in mm, both in the camera's frame."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import RigidTransform, Rotation, RotationSpline


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
    """A smooth path through poses [N, 4, 4] at the times 0, 1, …; beyond its ends it goes on as there."""

    def __init__(self, T_world_camera: np.ndarray):
        self.T_world_camera = T_world_camera
        times = np.arange(len(T_world_camera))
        if len(times) > 1:
            self._places = CubicSpline(times, T_world_camera[:, :3, 3])
            self._turns = RotationSpline(times, Rotation.from_matrix(T_world_camera[:, :3, :3]))

    def later(self, lag: float) -> np.ndarray:
        """The poses [N, 4, 4] of ``lag`` frames later."""
        count = len(self.T_world_camera)
        if lag == 0 or count < 2:
            return self.T_world_camera.copy()
        times = np.arange(count) + lag
        inside = np.clip(times, 0, count - 1)
        T = np.tile(np.eye(4), (count, 1, 1))
        T[:, :3, :3] = self._turns(inside).as_matrix()
        T[:, :3, 3] = self._places(inside)
        for end in np.flatnonzero(times != inside):
            before = self._at(2 * inside[end] - times[end])
            T[end] = T[end] @ np.linalg.inv(before) @ T[end]
        return T

    def _at(self, time: float) -> np.ndarray:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self._turns(time).as_matrix(), self._places(time)
        return T

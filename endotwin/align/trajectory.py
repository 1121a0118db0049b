"""How far a trajectory lies from another: ATE and RPE, as evo has them (Sturm et al., IROS 2012)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from endotwin.errors import TrajectoryError


@dataclass(frozen=True)
class Apart:
    """Root mean squares over poses, or over steps from one pose to the next.

    Attributes:
        ate_mm, ate_deg: of poses as they stand. aligned_mm: of places after the best rigid motion of all;
            aligned_deg: of turns after the best turn of all.
        rpe_mm, rpe_deg: of steps.
    """

    ate_mm: float
    ate_deg: float
    aligned_mm: float
    aligned_deg: float
    rpe_mm: float
    rpe_deg: float

    def __str__(self) -> str:
        return (
            f"ATE {self.ate_mm:.4f} mm, {self.ate_deg:.4f}° "
            f"(after the best rigid motion {self.aligned_mm:.4f} mm, {self.aligned_deg:.4f}°); "
            f"RPE a frame {self.rpe_mm:.4f} mm, {self.rpe_deg:.4f}°"
        )


def compare(T: np.ndarray, T_true: np.ndarray) -> Apart:
    """Errors of poses ``T`` against ``T_true``, both [N, 4, 4], paired in order.

    Raises:
        TrajectoryError: they are not as many.
    """
    if len(T) != len(T_true):
        raise TrajectoryError(f"{len(T_true)} poses to compare with, but {len(T)} frames; give one a frame")
    apart = np.linalg.inv(T_true) @ T
    steps = np.linalg.inv(np.linalg.inv(T_true[:-1]) @ T_true[1:]) @ (np.linalg.inv(T[:-1]) @ T[1:])
    place, true = T[:, :3, 3], T_true[:, :3, 3]
    return Apart(
        ate_mm=_rms(np.linalg.norm(place - true, axis=1)),
        ate_deg=_rms(_degrees(apart)),
        aligned_mm=_rms(np.linalg.norm(_superposed(place, true) - true, axis=1)),
        aligned_deg=_rms(_degrees(_turned_alike(T, T_true))),
        rpe_mm=_rms(np.linalg.norm(steps[:, :3, 3], axis=1)),
        rpe_deg=_rms(_degrees(steps)),
    )


def _superposed(points: np.ndarray, onto: np.ndarray) -> np.ndarray:
    """``points`` [N, 3] rigidly moved next to ``onto`` (Kabsch 1976)."""
    centred, target = points - points.mean(axis=0), onto - onto.mean(axis=0)
    left, _, right = np.linalg.svd(target.T @ centred)
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    return centred @ (left @ mirror @ right).T + onto.mean(axis=0)


def _turned_alike(T: np.ndarray, T_true: np.ndarray) -> np.ndarray:
    """What is left [N, 4, 4] between the turns of poses after the one that they have in common: places on a
    straight path would not tell it."""
    turns, true = (Rotation.from_matrix(each[:, :3, :3]) for each in (T, T_true))
    common = (true * turns.inv()).mean()
    return (true.inv() * common * turns).as_matrix()


def _degrees(T: np.ndarray) -> np.ndarray:
    return np.degrees(Rotation.from_matrix(T[:, :3, :3]).magnitude())


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0

"""What may be wrong with a sequence's registration, from what all photos share to what each has of its own.

A robot's poses meet a model through one placement of the model (6 numbers), one hand-eye matrix (6) and one
lag of the clock: T(t) = M · T_written(t + lag) · X (Bobrow et al. 2023 register C3VD so). The calibration
that depth was rendered with may not be that of the photos: focal length and centre (3). What is left drifts
slowly, and a little differs from photo to photo: a Gaussian process along time, of which photos that have no
say get what is smooth.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from endotwin.align.motion import Path, adjoint, moved, twists_between

PLACED, SHARED = 13, 16
"""Model, hand-eye, lag; and intrinsics beside them."""

OF_PHOTO = 9
"""What moves a photo's picture: its camera's twist and its intrinsics."""

SPREAD_MM, SPREAD_DEG, SPREAD_LAG = 0.3, 0.2, 0.3
"""Standard deviation of each number of the model's place and of the hand-eye matrix (C3VD: .32 mm and .16° in
all), and of the lag in frames."""

SPREAD_FOCAL, SPREAD_CENTRE = 0.005, 0.004
"""The same of a focal length, of itself, and of a centre, of the width: calibrations of one C3VD scope differ
by 3 to 6 px of 1350."""

OWN_MM, OWN_DEG = 0.1, 0.06
"""Standard deviation, in each direction, of what a photo has of its own."""

DRIFT_SHARE, DRIFT_FRAMES = 0.7, 6.0
"""Share of its variance that drifts, and over how many frames it is remembered."""

LAG_STEP = 0.02


@dataclass(frozen=True, eq=False)
class Corrections:
    """Corrections of N written poses.

    Attributes:
        path: through the written poses. centre_mm: float64 [3], about which the model turns.
        shared: float64 [16]: twist of the model, twist of the hand-eye matrix, lag in frames, intrinsics (see
            ``Camera.corrected``).
        own: float64 [N, 6], twist of each photo.
    """

    path: Path
    centre_mm: np.ndarray
    shared: np.ndarray = field(default_factory=lambda: np.zeros(SHARED))
    own: np.ndarray | None = None

    @classmethod
    def none(cls, T_world_camera: np.ndarray) -> Corrections:
        """No corrections of written poses [N, 4, 4]."""
        own = np.zeros((len(T_world_camera), 6))
        return cls(Path(T_world_camera), T_world_camera[:, :3, 3].mean(axis=0), own=own)

    @property
    def poses(self) -> np.ndarray:
        """The corrected T_world_camera, float64 [N, 4, 4]."""
        return self._poses(self.shared[12])

    @property
    def twists(self) -> np.ndarray:
        """The corrections in each camera's frame, float64 [N, 6]."""
        return twists_between(self.path.T_world_camera, self.poses)

    @property
    def intrinsics(self) -> np.ndarray:
        """What is wrong with the photos' camera, float64 [3] (see ``Camera.corrected``)."""
        return self.shared[PLACED:]

    def _poses(self, lag: float) -> np.ndarray:
        placed = self.path.later(lag)
        placed[:, :3, 3] -= self.centre_mm
        model = moved(np.eye(4), self.shared[:6])
        placed = model @ moved(placed, self.shared[6:12])
        placed[:, :3, 3] += self.centre_mm
        return moved(placed, self.own)

    def slopes(self) -> np.ndarray:
        """Twist and intrinsics of each photo by each shared number, float64 [N, 9, 16], to first order."""
        T = self.poses
        T[:, :3, 3] -= self.centre_mm
        by_model = adjoint(np.linalg.inv(T))
        by_hand_eye = adjoint(np.linalg.inv(moved(np.tile(np.eye(4), (len(T), 1, 1)), self.own)))
        lag = self.shared[12]
        by_lag = twists_between(self._poses(lag - LAG_STEP), self._poses(lag + LAG_STEP)) / (2 * LAG_STEP)
        found = np.zeros((len(T), OF_PHOTO, SHARED))
        found[:, :6, :PLACED] = np.concatenate([by_model, by_hand_eye, by_lag[:, :, None]], axis=2)
        found[:, 6:, PLACED:] = np.eye(3)
        return found

    def stepped(self, shared: np.ndarray, own: np.ndarray, frames: np.ndarray) -> Corrections:
        """With ``shared`` [16] and ``own`` [F, 6] of ``frames`` [F] added; photos between follow the
        drift."""
        told = self.own[frames] + own
        times = np.arange(len(self.own))
        drift = _drift(times[:, None] - frames)
        smooth = drift @ np.linalg.solve(own_covariance(frames), told)
        smooth[frames] = told
        return replace(self, shared=self.shared + shared, own=smooth)


def shared_spread() -> np.ndarray:
    """Prior standard deviations of the shared numbers, [16]."""
    one = np.r_[np.full(3, np.radians(SPREAD_DEG)), np.full(3, SPREAD_MM)]
    return np.r_[one, one, SPREAD_LAG, SPREAD_FOCAL, SPREAD_CENTRE, SPREAD_CENTRE]


def pose_precision() -> np.ndarray:
    """Prior precision [6, 6] of a pose's twist, which errs as the hand-eye matrix does."""
    return np.diag(1 / shared_spread()[:6] ** 2)


def own_spread() -> np.ndarray:
    """Prior standard deviations of a photo's own twist, [6]."""
    return np.r_[np.full(3, np.radians(OWN_DEG)), np.full(3, OWN_MM)]


def own_covariance(frames: np.ndarray) -> np.ndarray:
    """Prior covariance [F, F] of one direction of the photos' own twists, in units of its variance."""
    return _drift(frames[:, None] - frames) + (1 - DRIFT_SHARE) * np.eye(len(frames))


def _drift(apart: np.ndarray) -> np.ndarray:
    return DRIFT_SHARE * np.exp(-0.5 * (apart / DRIFT_FRAMES) ** 2)

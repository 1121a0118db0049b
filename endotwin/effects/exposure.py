"""When each row of the image sees the scene, and the mean radiance that it sees meanwhile.

Time is counted in frame intervals from the pose that labels the photo: the middle row's exposure has its
middle there. Row r of H is read at t = readout·((r + ½)/H − ½) and sees the scene from t − shutter/2 to
t + shutter/2. Between two poses the camera moves on one screw, T(t) = T(0)·exp(t·log(T(0)⁻¹·T(1))).
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as Ordered
from dataclasses import dataclass
from functools import cached_property
from math import ceil

import numpy as np
import torch
from scipy.spatial.transform import RigidTransform
from torch import Tensor

from endotwin.cameras import Camera
from endotwin.effects.effect import Effect

Film = Callable[[np.ndarray, np.ndarray | None], Tensor]
"""``film(T_world_camera, mask)``: linear radiance float32 [H, W, 3] at a pose; outside the mask, anything."""

SAMPLE_PX = 1.0
"""A blurred pixel is a mean over poses at most this far apart."""

STRIP_PX = 0.5
"""Rows of one pose move by at most this much between the first and the last of them."""

STILL_PX = 0.25
"""Motion during the exposure that no photo shows."""

MAX_POSES = 32
"""Poses that one pixel is a mean of, at most."""

FASTEST_SHARE = 0.01
"""Share of the pixels that may move faster than the speed that sets the number of poses."""

GRID = 64
"""The speed is taken on at most GRID × GRID pixels."""

INSTANT = 1e-3


@dataclass(frozen=True)
class Shot:
    """One photo to be taken from a moving camera.

    Attributes:
        camera: its model. T_world_camera: float64 [4, 4], the pose that labels the photo.
        T_world_next: float64 [4, 4], the pose one frame interval later; the same one if the camera is still.
        depth_mm: [H, W], z-depth from the labelled pose; NaN where there is no surface. It only tells how
            fast pixels move.
        shutter: time that each row is exposed. readout: time from the first row to the last. In frame
            intervals.
    """

    camera: Camera
    T_world_camera: np.ndarray
    T_world_next: np.ndarray
    depth_mm: np.ndarray | Tensor
    shutter: float = 0.0
    readout: float = 0.0

    def pose(self, time: float) -> np.ndarray:
        """``T_world_camera`` [4, 4] at ``time``."""
        if time == 0:
            return self.T_world_camera
        return self.T_world_camera @ RigidTransform.from_exp_coords(time * self._screw).as_matrix()

    @cached_property
    def _screw(self) -> np.ndarray:
        """log(T(0)⁻¹·T(1)), [6]; zeros for equal poses."""
        return _screw(self.T_world_camera, self.T_world_next)

    @cached_property
    def speed_px(self) -> float:
        """Pixels that the image moves a frame interval; all but FASTEST_SHARE of its pixels are slower."""
        depth_mm = np.asarray(self.depth_mm)
        if not depth_mm.size or not self._screw.any():
            return 0.0
        every = tuple(slice(None, None, ceil(size / GRID)) for size in depth_mm.shape)
        rays, depth_mm = self.camera.pixel_directions[every], depth_mm[every]
        with np.errstate(divide="ignore", invalid="ignore"):
            points = (rays * (depth_mm / rays[..., 2])[..., None]).astype(np.float64)
        seen = points[np.isfinite(points).all(axis=-1)]
        later = np.linalg.inv(RigidTransform.from_exp_coords(INSTANT * self._screw).as_matrix())
        shift = self.camera.project(seen @ later[:3, :3].T + later[:3, 3]) - self.camera.project(seen)
        speeds = np.linalg.norm(shift, axis=-1) / INSTANT
        speeds = speeds[np.isfinite(speeds)]
        return float(np.quantile(speeds, 1 - FASTEST_SHARE)) if len(speeds) else 0.0


class ExposureEffect(Effect):
    """An effect that says when rows are exposed; ``expose`` then is one for all of them."""

    def timed(self, shot: Shot) -> Shot:
        """The shot, taken this way."""
        raise NotImplementedError

    def expose(self, film: Film, shot: Shot) -> Tensor:
        """Mean radiance float32 [H, W, 3] of each pixel over its exposure."""
        return expose(film, shot, [self])


def expose(film: Film, shot: Shot, effects: Ordered[ExposureEffect] = ()) -> Tensor:
    """Mean radiance float32 [H, W, 3] of each pixel over its row's exposure, with all ``effects`` at once.

    Poses are taken at equal steps of time, near enough for the image to move by a pixel between two; each is
    rendered only in the rows that are exposed then. So motion blur costs a frame a pixel of it, rolling
    shutter about one frame, and a camera that is still exactly one.
    """
    for effect in effects:
        shot = effect.timed(shot)
    poses, step = _sampling(shot)
    height, width = shot.camera.height, shot.camera.width
    if step == 0:
        return film(shot.T_world_camera, None)
    read_at = shot.readout * ((np.arange(height) + 0.5) / height - 0.5)
    first = np.rint(read_at / step).astype(int)
    total = torch.zeros(height, width, 3)
    for index in range(first[0], first[-1] + poses):
        top, bottom = np.searchsorted(first, (index - poses + 1, index + 1))
        rows = slice(int(top), int(bottom))
        if rows.start == rows.stop:
            continue
        mask = None
        if rows != slice(0, height):
            mask = np.zeros((height, width), bool)
            mask[rows] = True
        total[rows] += film(shot.pose((index - (poses - 1) / 2) * step), mask)[rows]
    return total / poses


def following(T_world_camera: np.ndarray, numbers: np.ndarray | None = None) -> np.ndarray:
    """The pose one frame later of each pose [N, 4, 4] of a trajectory; the last one goes on as before.

    ``numbers`` [N] of the frames, ascending, where poses are missing: between two the camera moves on one
    screw.
    """
    T = np.asarray(T_world_camera, np.float64)
    if len(T) < 2:
        return T.copy()
    later = T[1:].copy()
    if numbers is not None:
        frames = np.diff(numbers)
        for k in np.flatnonzero(frames > 1):
            later[k] = T[k] @ RigidTransform.from_exp_coords(_screw(T[k], T[k + 1]) / frames[k]).as_matrix()
    return np.concatenate([later, T[-1:] @ np.linalg.inv(T[-2:-1]) @ later[-1:]])


def _screw(T: np.ndarray, T_next: np.ndarray) -> np.ndarray:
    """log(T⁻¹·T_next), [6]; zeros for equal poses [4, 4]."""
    if np.array_equal(T, T_next):
        return np.zeros(6)
    return RigidTransform.from_matrix(np.linalg.inv(T) @ T_next).as_exp_coords()


def _sampling(shot: Shot) -> tuple[int, float]:
    """How many poses a row is a mean of, and the time between them; a step of 0 is a still."""
    blur_px, skew_px = shot.shutter * shot.speed_px, shot.readout * shot.speed_px
    if blur_px > STILL_PX:
        poses = min(ceil(blur_px / SAMPLE_PX) + 1, MAX_POSES)
        return poses, shot.shutter / poses
    if skew_px > STILL_PX:
        return 1, shot.readout / min(ceil(skew_px / STRIP_PX), shot.camera.height)
    return 1, 0.0

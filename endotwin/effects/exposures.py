"""How a camera's exposure changes from one photo to the next, by the tissue that both show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from endotwin.effects.luma import LUMA
from endotwin.errors import SequenceError
from endotwin.run.ahead import ahead
from endotwin.run.threads import THREADS
from endotwin.sequence import Sequence

GRID = 160
"""A photo is looked at in so many columns, or a few more."""

GAMMA = 1 / 2.2
"""Response of a display. With another one less than all of what depth tells is taken off."""

DARKEST, BRIGHTEST = 10, 240
"""Levels, of 255, between which display values follow the response."""

LEAST_COSINE = 0.3
"""Of the angle at which tissue is seen: towards grazing its normal by depth errs most."""

SAME = 0.01
"""Relative difference of two depths up to which they are of one place."""

FEWEST = 100
"""Pixels that two photos must share."""


@dataclass(frozen=True)
class Exposures:
    """Of photos that follow each other.

    Attributes:
        log_change: float64 [F − 1], rise of ln of a display value from a photo to the next that neither
            distance nor angle explains. log_level: float64 [F], ln of the mean display value.
    """

    log_change: np.ndarray
    log_level: np.ndarray

    @property
    def log_unheld(self) -> np.ndarray:
        """What ``log_level`` would be at the exposure of the first photo, float64 [F]."""
        return self.log_level - np.concatenate([[0.0], np.cumsum(self.log_change)])

    @classmethod
    def of(cls, sequence: Sequence, frames: range) -> Exposures:
        """Of consecutive ``frames``: the median of ln C − γ·ln(cosθ cos²ω/d²) over the pixels that two share,
        where θ is light's angle at the tissue and ω that at the lens, its source.

        Raises SequenceError where two photos share no tissue, or where depth or photos are damaged.
        """
        changes, levels, before = [], [], None
        for now in ahead(lambda index: _Seen.of(sequence, index), frames, THREADS):
            levels.append(now.log_level)
            if before is not None:
                changes.append(before.log_change_to(now, sequence))
            before = now
        return cls(np.array(changes), np.array(levels))


@dataclass(frozen=True)
class _Seen:
    """A photo on a grid of pixels: points_mm [h, w, 3] in the camera frame, log_albedo [h, w], ln of display
    values less what light there is, NaN where unknown; its step in px, and ln of the mean of all pixels."""

    index: int
    step: int
    points_mm: np.ndarray
    log_albedo: np.ndarray
    log_level: float

    @classmethod
    def of(cls, sequence: Sequence, index: int) -> _Seen:
        step = max(sequence.camera.width // GRID, 1)
        grid = np.s_[::step, ::step]
        rays, color = sequence.camera.pixel_directions[grid].astype(float), sequence.color(index)
        with np.errstate(all="ignore"):
            points_mm = rays * (sequence.depth_mm(index)[grid] / rays[..., 2])[..., None]
            normal = np.cross(np.gradient(points_mm, axis=1), np.gradient(points_mm, axis=0))
            cosine = np.abs((normal * rays).sum(axis=2)) / np.linalg.norm(normal, axis=2)
            log_light = np.log(cosine * rays[..., 2] ** 2 / (points_mm**2).sum(axis=2))
            log_albedo = np.log(color[grid] @ LUMA) - GAMMA * log_light
        levels = color[grid]
        usable = (levels.min(axis=2) > DARKEST) & (levels.max(axis=2) < BRIGHTEST) & (cosine > LEAST_COSINE)
        log_albedo[~(usable & sequence.lens_mask[grid])] = np.nan
        return cls(index, step, points_mm, log_albedo, float(np.log(max(color.mean(), 1) / 255)))

    def log_change_to(self, later: _Seen, sequence: Sequence) -> float:
        """Median rise of ln of display values from this photo to a ``later`` one."""
        T_later_self = (
            np.linalg.inv(sequence.T_world_camera[later.index]) @ sequence.T_world_camera[self.index]
        )
        known = np.isfinite(self.log_albedo)
        points_mm = self.points_mm[known] @ T_later_self[:3, :3].T + T_later_self[:3, 3]
        place = np.rint(sequence.camera.project(points_mm) / later.step)
        height, width = later.log_albedo.shape
        inside = ((place >= 0) & (place < (width, height))).all(axis=1) & (points_mm[:, 2] > 0)
        column, row = place[inside].astype(int).T
        z_mm = points_mm[inside, 2]
        rise = later.log_albedo[row, column] - self.log_albedo[known][inside]
        rise = rise[np.isfinite(rise) & (np.abs(later.points_mm[row, column, 2] - z_mm) < SAME * z_mm)]
        if len(rise) < FEWEST:
            raise SequenceError(
                f"photos {self.index} and {later.index} of {sequence.path} share no tissue by their depth"
            )
        return float(np.median(rise))

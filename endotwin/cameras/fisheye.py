"""The fisheye camera of OpenCV (Kannala–Brandt), as in ``cv2.fisheye``, but for more than 180° too."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.polynomial import Polynomial

from endotwin.cameras.base import (
    Camera,
    first_positive_root,
    inverse_of_increasing,
    scaled_lengths,
)


@dataclass(frozen=True)
class Fisheye(Camera):
    """OpenCV's fisheye: image radius θ_d = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸), θ the angle from the axis.

    Attributes:
        fx, fy, cx, cy: focal lengths and principal point in pixels; the first pixel's centre is 0.
        k1, k2, k3, k4: distortion.
    """

    model: ClassVar[str] = "fisheye"
    positive: ClassVar[tuple[str, ...]] = ("fx", "fy")
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    @cached_property
    def _theta_d(self) -> Polynomial:
        return Polynomial([0, 1, 0, self.k1, 0, self.k2, 0, self.k3, 0, self.k4])

    @cached_property
    def _max_theta(self) -> float:
        return min(first_positive_root(self._theta_d.deriv()), np.pi)

    def directions(self, uv: np.ndarray) -> np.ndarray:
        distorted = (np.asarray(uv, np.float64) - (self.cx, self.cy)) / (self.fx, self.fy)
        theta_d = np.linalg.norm(distorted, axis=-1)
        theta = inverse_of_increasing(self._theta_d, theta_d, (0.0, self._max_theta))
        for _ in range(2):
            theta = theta - (self._theta_d(theta) - theta_d) / self._theta_d.deriv()(theta)
        sideways = np.where(theta_d > 0, np.sin(theta) / np.where(theta_d > 0, theta_d, 1), 0 * theta)
        return np.concatenate([distorted * sideways[..., None], np.cos(theta)[..., None]], axis=-1)

    def project(self, points: np.ndarray) -> np.ndarray:
        points = np.asarray(points, np.float64)
        radius = np.linalg.norm(points[..., :2], axis=-1)
        theta = np.arctan2(radius, points[..., 2])
        defined = (theta < self._max_theta) & ((radius > 0) | (points[..., 2] > 0))
        theta_d = np.where(defined, self._theta_d(theta), np.nan)
        distorted = points[..., :2] * (theta_d / np.where(radius > 0, radius, 1))[..., None]
        return distorted * (self.fx, self.fy) + (self.cx, self.cy)

    def scaled(self, scale: float) -> Fisheye:
        return replace(self, **scaled_lengths(self, scale))

    def lengthened(self, factor: float) -> Fisheye:
        return replace(self, fx=self.fx * factor, fy=self.fy * factor)

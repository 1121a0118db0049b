"""Pinhole with Brown–Conrady distortion: the model of OpenCV's ``calibrateCamera``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import cv2
import numpy as np
from numpy.polynomial import Polynomial

from endotwin.cameras.base import Camera, first_positive_root, scaled_lengths

NEWTON_STEPS = 30
CONVERGED = 1e-11  # in normalised coordinates, before the last step
POINTS_AT_ONCE = 1 << 16  # OpenCV's Jacobian takes 300 bytes a point


@dataclass(frozen=True)
class Pinhole(Camera):
    """Pinhole camera; distortion as in OpenCV, off unless given.

    With (x, y) = (X/Z, Y/Z), r² = x² + y²:
    x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶)/(1 + k4 r² + k5 r⁴ + k6 r⁶) + 2 p1 x y + p2 (r² + 2 x²), y' alike,
    u = fx x' + cx.

    Attributes:
        fx, fy, cx, cy: focal lengths and principal point in pixels; the first pixel's centre is 0.
        k1, k2, k3, k4, k5, k6: radial, p1, p2: tangential distortion.
    """

    model: ClassVar[str] = "pinhole"
    positive: ClassVar[tuple[str, ...]] = ("fx", "fy")
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0

    @property
    def matrix(self) -> np.ndarray:
        """The camera matrix K, float64 [3, 3]."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], np.float64)

    @property
    def distortion(self) -> np.ndarray:
        """OpenCV's coefficients, float64 [8]: k1 k2 p1 p2 k3 k4 k5 k6."""
        return np.array([self.k1, self.k2, self.p1, self.p2, self.k3, self.k4, self.k5, self.k6], np.float64)

    @cached_property
    def _max_radius(self) -> float:
        """Least r = |(x, y)| where the radial distortion stops growing; inf where it always grows."""
        radius = Polynomial([0, 1])
        squared = radius**2
        above = radius * (1 + self.k1 * squared + self.k2 * squared**2 + self.k3 * squared**3)
        below = 1 + self.k4 * squared + self.k5 * squared**2 + self.k6 * squared**3
        return min(
            first_positive_root(above.deriv() * below - above * below.deriv()), first_positive_root(below)
        )

    def directions(self, uv: np.ndarray) -> np.ndarray:
        uv = np.asarray(uv, np.float64)
        x, y = (uv[..., 0] - self.cx) / self.fx, (uv[..., 1] - self.cy) / self.fy
        if self.distortion.any():
            flat = np.stack([x, y], axis=-1).reshape(-1, 2)
            parts = np.array_split(flat, len(flat) // POINTS_AT_ONCE + 1)
            xy = np.concatenate([self._undistorted(part) for part in parts]).reshape(uv.shape)
            x, y = xy[..., 0], xy[..., 1]
        ray = np.stack([x, y, np.ones_like(x)], axis=-1)
        return ray / np.linalg.norm(ray, axis=-1, keepdims=True)

    def project(self, points: np.ndarray) -> np.ndarray:
        points = np.asarray(points)
        z = points[..., 2].astype(np.float64)
        z = np.where(z > 0, z, np.nan)
        xy = np.empty((*z.shape, 2))  # filled by columns, in a third of the time
        xy[..., 0], xy[..., 1] = points[..., 0] / z, points[..., 1] / z
        if self.distortion.any():
            xy = np.where((xy**2).sum(axis=-1, keepdims=True) < self._max_radius**2, xy, np.nan)
            xy = self._distorted(xy.reshape(-1, 2)).reshape(xy.shape)
        xy[..., 0] *= self.fx
        xy[..., 1] *= self.fy
        xy[..., 0] += self.cx
        xy[..., 1] += self.cy
        return xy

    def scaled(self, scale: float) -> Pinhole:
        return replace(self, **scaled_lengths(self, scale))

    def lengthened(self, factor: float) -> Pinhole:
        return replace(self, fx=self.fx * factor, fy=self.fy * factor)

    def _distorted(self, xy: np.ndarray) -> np.ndarray:
        """Distorted normalised coordinates [N, 2] of undistorted ones [N, 2]."""
        return self._distorted_with_slope(xy)[0]

    def _distorted_with_slope(self, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As ``_distorted``, with its derivative [N, 2, 2]: OpenCV's by the translation, at depth 1."""
        if not len(xy):
            return xy, np.zeros((0, 2, 2))
        points = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
        distorted, slopes = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), self.distortion)
        return distorted.reshape(-1, 2), slopes[:, 3:5].reshape(-1, 2, 2)

    def _undistorted(self, distorted: np.ndarray) -> np.ndarray:
        """The inverse of ``_distorted`` [N, 2] by Newton's method, NaN where there is none."""
        xy = distorted.copy()
        pending = np.arange(len(xy))
        for _ in range(NEWTON_STEPS):
            value, slope = self._distorted_with_slope(xy[pending])
            missed = distorted[pending] - value
            (a, b), (c, d) = slope.transpose(1, 2, 0)
            determinant = a * d - b * c
            determinant = np.where(determinant > 0, determinant, np.nan)
            xy[pending, 0] += (d * missed[:, 0] - b * missed[:, 1]) / determinant
            xy[pending, 1] += (a * missed[:, 1] - c * missed[:, 0]) / determinant
            pending = pending[np.abs(missed).max(axis=1) > CONVERGED]
        inside = (xy**2).sum(axis=1) < self._max_radius**2
        inside[pending] = False
        return np.where(inside[:, None], xy, np.nan)

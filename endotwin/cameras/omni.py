"""Scaramuzza's omnidirectional camera: the model of C3VD and of MATLAB's fisheye calibration."""

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
    scaled_centre,
    scaled_size,
)

REACH = 2.0  # points are projected as far out as this many times the farthest corner


@dataclass(frozen=True)
class Omni(Camera):
    """Scaramuzza's polynomial camera (Scaramuzza, Martinelli & Siegwart, ICVS 2006).

    With x = A⁻¹ (u − centre), A = [[c, d], [e, 1]], ρ = |x|: ray ∝ (x, f(ρ)),
    f(ρ) = a0 + a2 ρ² + a3 ρ³ + a4 ρ⁴. f < 0 looks backwards, so the field of view may pass 180°.

    Attributes:
        cx, cy: centre of distortion in pixels; the first pixel's centre is 0.
        a0, a2, a3, a4: coefficients of f, in pixels to the powers 1, −1, −2, −3.
        c, d, e: the sensor's affine misalignment.
    """

    model: ClassVar[str] = "omni"
    positive: ClassVar[tuple[str, ...]] = ("a0", "c")
    cx: float
    cy: float
    a0: float
    a2: float
    a3: float
    a4: float
    c: float = 1.0
    d: float = 0.0
    e: float = 0.0

    @property
    def affine(self) -> np.ndarray:
        """The matrix A, float64 [2, 2]."""
        return np.array([[self.c, self.d], [self.e, 1.0]], np.float64)

    @cached_property
    def _f(self) -> Polynomial:
        return Polynomial([self.a0, 0, self.a2, self.a3, self.a4])

    @cached_property
    def _max_rho(self) -> float:
        """Largest ρ at which the angle still grows with ρ (f − ρ f′ > 0), bounded by ``REACH``."""
        corners = np.array([[0, 0], [self.width, 0], [0, self.height], [self.width, self.height]], np.float64)
        farthest = np.linalg.norm(self._ideal(corners), axis=1).max()
        turns = first_positive_root(self._f - Polynomial([0, 1]) * self._f.deriv())
        return min(turns, REACH * farthest)

    def _ideal(self, uv: np.ndarray) -> np.ndarray:
        return (uv - (self.cx, self.cy)) @ np.linalg.inv(self.affine).T

    def directions(self, uv: np.ndarray) -> np.ndarray:
        x = self._ideal(np.asarray(uv, np.float64))
        rho = np.linalg.norm(x, axis=-1)
        z = np.where(rho < self._max_rho, self._f(rho), np.nan)
        ray = np.concatenate([np.where(np.isfinite(z), 1, np.nan)[..., None] * x, z[..., None]], axis=-1)
        return ray / np.linalg.norm(ray, axis=-1, keepdims=True)

    def project(self, points: np.ndarray) -> np.ndarray:
        points = np.asarray(points, np.float64)
        radius, z = np.linalg.norm(points[..., :2], axis=-1), points[..., 2]
        rho = inverse_of_increasing(
            lambda rho: np.arctan2(rho, self._f(rho)), np.arctan2(radius, z), (0.0, self._max_rho)
        )
        rho = self._polished(rho, radius, z)
        rho = np.where((radius == 0) & (z <= 0), np.nan, rho)
        x = points[..., :2] * (rho / np.where(radius > 0, radius, 1))[..., None]
        return x @ self.affine.T + (self.cx, self.cy)

    def _polished(self, rho: np.ndarray, radius: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Two Newton steps on ρ z − r f(ρ) = 0, whose slope is positive wherever the angle grows with ρ."""
        slope_of_f = self._f.deriv()
        for _ in range(2):
            slope = z - radius * slope_of_f(rho)
            rho = rho - (rho * z - radius * self._f(rho)) / np.where(slope == 0, np.nan, slope)
        return rho

    def scaled(self, scale: float) -> Omni:
        width, height, ratio_x, ratio_y = scaled_size(self, scale)
        return replace(
            self,
            width=width,
            height=height,
            cx=scaled_centre(self.cx, ratio_x),
            cy=scaled_centre(self.cy, ratio_y),
            c=self.c * ratio_x / ratio_y,
            d=self.d * ratio_x / ratio_y,
        ).lengthened(ratio_y)

    def lengthened(self, factor: float) -> Omni:
        a2, a3, a4 = self.a2 / factor, self.a3 / factor**2, self.a4 / factor**3
        return replace(self, a0=self.a0 * factor, a2=a2, a3=a3, a4=a4)

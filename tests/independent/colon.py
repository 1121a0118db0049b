"""The shape of a random colon: a bent tube with folds, closed far beyond what the camera sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.integrate import cumulative_trapezoid

COLUMNS = 256
"""Points around the lumen: 0.25 to 0.6 mm apart."""

LENGTH = 11.0
"""Length in radii: at least four lie ahead of the camera and behind it."""

TIGHTEST_BEND = 2.6
"""Least radius of a bend in radii of the lumen."""

FINE_MM = 0.02


@dataclass(frozen=True)
class Centreline:
    """A curve by its length s, float64: points [S, 3], axes [S, 3, 3] (columns right, down, forward)."""

    s_mm: np.ndarray
    points_mm: np.ndarray
    axes: np.ndarray

    def at(self, s_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points [N, 3] and axes [N, 3, 3] at lengths [N]."""
        index = np.clip(np.searchsorted(self.s_mm, s_mm), 0, len(self.s_mm) - 1)
        return self.points_mm[index], self.axes[index]


@dataclass(frozen=True)
class Colon:
    """A random lumen.

    Attributes:
        radius_mm: of the tube between folds. line: its centreline. points_mm: its wall, float64 [M, N, 3],
            rows along the line and columns about it.
    """

    radius_mm: float
    line: Centreline
    points_mm: np.ndarray

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Colon:
        """A colon of random radius, bends and folds."""
        radius_mm = float(rng.uniform(10, 25))
        line = _centreline(rng, radius_mm)
        profile = _Profile.draw(rng, radius_mm, line.s_mm[-1])
        angle = 2 * np.pi * np.arange(COLUMNS) / COLUMNS
        rows_mm = _even_rows(profile, line.s_mm, 2 * np.pi * radius_mm / COLUMNS)
        reach_mm = profile.reach_mm(rows_mm[:, None], angle[None])
        reach_mm *= 1 + _bumps(rng, reach_mm.shape)
        centre, axes = line.at(rows_mm)
        outward = np.cos(angle)[:, None] * axes[:, None, :, 0] + np.sin(angle)[:, None] * axes[:, None, :, 1]
        return cls(radius_mm, line, centre[:, None] + reach_mm[..., None] * outward)


@dataclass(frozen=True)
class _Profile:
    """Distance from the centreline to the wall: a rounded triangle, less its folds.

    Attributes:
        folds: rows of (s, height, width, tilt, direction of the tilt, middle of the crescent).
    """

    radius_mm: float
    length_mm: float
    triangular: float
    turn: float
    folds: np.ndarray

    @classmethod
    def draw(cls, rng: np.random.Generator, radius_mm: float, length_mm: float) -> _Profile:
        spacing, height, width = rng.uniform([0.5, 0.10, 0.07], [1.2, 0.34, 0.16]) * radius_mm
        places = np.arange(spacing, length_mm - spacing, spacing)
        lows = [-0.25 * spacing, 0.6 * height, 0.8 * width, 0, 0, 0]
        highs = [0.25 * spacing, 1.2 * height, 1.3 * width, 0.2 * radius_mm, 2 * np.pi, 2 * np.pi]
        folds = rng.uniform(lows, highs, (len(places), 6))
        folds[:, 0] += places
        return cls(radius_mm, length_mm, float(rng.uniform(0.02, 0.09)), float(rng.uniform(0, 6)), folds)

    def reach_mm(self, s_mm: np.ndarray, angle: np.ndarray) -> np.ndarray:
        """Distance at length and angle of any shapes that broadcast; 0 at both ends, which are rounded."""
        reach = self.radius_mm * (1 + self.triangular * np.cos(3 * angle + self.turn) + 0 * s_mm)
        for place, height, width, tilt, tilted, middle in self.folds:
            along = s_mm - place - tilt * np.cos(angle - tilted)
            crescent = 0.55 + 0.25 * np.cos(3 * (angle - middle)) + 0.2 * np.cos(angle - middle)
            reach = reach - height * crescent * np.exp(-((along / width) ** 2))
        ahead = np.clip(np.minimum(s_mm, self.length_mm - s_mm) / self.radius_mm, 0, 1)
        return reach * np.sqrt(1 - (1 - ahead) ** 2)


def _centreline(rng: np.random.Generator, radius_mm: float) -> Centreline:
    s_mm = np.arange(0, LENGTH * radius_mm, FINE_MM)
    turns = np.zeros((2, len(s_mm)))
    for turn in turns:
        for _ in range(3):
            wave, phase = rng.uniform([4, 0], [12, 2 * np.pi]) * (radius_mm, 1)
            turn += rng.uniform(0.2, 1) * np.sin(2 * np.pi * s_mm / wave + phase)
    tightest = np.hypot(*turns).max() * TIGHTEST_BEND * radius_mm
    yaw, pitch = cumulative_trapezoid(turns / tightest, s_mm, axis=1, initial=0)
    forward = np.stack([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)], axis=1)
    right = np.stack([np.cos(yaw), 0 * yaw, -np.sin(yaw)], axis=1)
    points_mm = cumulative_trapezoid(forward, s_mm, axis=0, initial=0)
    return Centreline(s_mm, points_mm, np.stack([right, np.cross(forward, right), forward], axis=2))


def _even_rows(profile: _Profile, s_mm: np.ndarray, step_mm: float) -> np.ndarray:
    """Lengths [M] between which the wall is ``step_mm`` long, folds' flanks included; M is 1 more than a
    multiple of 4."""
    some = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    slope = np.gradient(profile.reach_mm(s_mm[:, None], some[None]), s_mm, axis=0)
    walked_mm = cumulative_trapezoid(np.hypot(1, slope).mean(axis=1), s_mm, initial=0)
    count = 4 * round(walked_mm[-1] / step_mm / 4) + 1
    return np.interp(np.linspace(0, walked_mm[-1], count), walked_mm, s_mm)


def _bumps(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """Relative unevenness [M, N] of the wall: about 1.5 % in swells, and a tenth of that in fine grain."""
    return 0.015 * smooth_noise(rng, shape, 12) + 0.0012 * smooth_noise(rng, shape, 2.5)


def smooth_noise(rng: np.random.Generator, shape: tuple[int, int], blur: float) -> np.ndarray:
    """A random field of variance 1 that wraps around, smooth over ``blur`` cells."""
    along, around = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None]
    passed = np.exp(-2 * (np.pi * blur) ** 2 * (along**2 + around**2))
    field = np.fft.irfft2(passed * np.fft.rfft2(rng.standard_normal(shape)), shape)
    return field / field.std()

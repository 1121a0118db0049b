"""How far a reading is off, in numbers with errors: scale, focal lengths, principal point, ray, timing.

Gauss–Newton on the residuals of all pairs at once. The errors allow for pairs that share a frame, whose
residuals share that frame's error (dyadic-robust variance: Aronow, Samii & Assenova, Political Analysis
2015).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from endotwin.check.reading import Reading
from endotwin.check.views import Views
from endotwin.check.warp import residuals

NAMES = ("log_scale", "log_focal_u", "log_focal_v", "centre_u", "centre_v", "ray", "shift")
STEPS = np.array([1e-3, 1e-3, 1e-3, 0.05, 0.05, 1e-2, 1e-2])
ITERATIONS = 2
PRIOR = np.array([0.3, 0.3, 0.3, 10.0, 10.0, 1.0, 3.0])
"""How far off each is at first glance: keeps what the motion cannot tell from running away."""


@dataclass(frozen=True)
class Estimate:
    """What a reading lacks.

    Attributes:
        step: float64 [7], in the order of ``NAMES``: what makes the frames agree better.
        error: float64 [7], its standard error.
    """

    step: np.ndarray
    error: np.ndarray

    def differs(self, index: int, least: float, errors: float = 6.0) -> bool:
        """Whether number ``index`` is at least ``least`` and far beyond its error from 0."""
        return abs(self.step[index]) > max(least, errors * self.error[index])


def estimate(views: Views, reading: Reading) -> Estimate:
    """Fit all numbers of ``NAMES`` at once, with a constant bias of the depth."""
    camera, total = views.sequence.camera, np.zeros(len(NAMES))
    for _ in range(ITERATIONS):
        around = reading.adjusted(camera, total)
        residual = residuals(views, around)
        slopes = [_slope(views, around, residual, index) for index in range(len(NAMES))]
        jacobian = np.stack([*slopes, np.ones(len(residual))], axis=1)
        step, covariance = _robust_step(views, residual, jacobian, total)
        total = total + step
    return Estimate(total, np.sqrt(np.diag(covariance)))


def _slope(views: Views, reading: Reading, residual: np.ndarray, index: int) -> np.ndarray:
    """Derivative of the residuals [S] by one number; backwards where a shift leaves the sequence."""
    camera, step = views.sequence.camera, np.zeros(len(NAMES))
    step[index] = STEPS[index]
    slope = (residuals(views, reading.adjusted(camera, step)) - residual) / STEPS[index]
    if NAMES[index] == "shift":
        behind = (residual - residuals(views, reading.adjusted(camera, -step))) / STEPS[index]
        slope = np.where(np.isfinite(slope), slope, behind)
    return slope


def _robust_step(
    views: Views, residual: np.ndarray, jacobian: np.ndarray, total: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """One step [7] and its covariance [7, 7]."""
    count = len(NAMES)
    good = np.isfinite(residual) & np.isfinite(jacobian).all(axis=1)
    if good.sum() < 100:
        return np.zeros(count), np.diag(PRIOR**2)
    steep = np.abs(jacobian) > 20 * np.median(np.abs(jacobian[good]), axis=0) + 1e-9
    good &= ~steep.any(axis=1)
    r, J, pair = residual[good], jacobian[good], views.pair[good]
    width = max(np.median(np.abs(r)) / 0.6745, 1e-9)
    weight = 1 / (1 + (r / (2 * width)) ** 2) / width**2
    prior = np.append(1 / PRIOR**2, 0)
    curvature = (J * weight[:, None]).T @ J + np.diag(prior)
    step = -np.linalg.solve(curvature, J.T @ (weight * r) + prior * np.append(total, 0))
    left = weight * (r + J @ step)
    scores = np.stack([np.bincount(pair, left * column, len(views.ends)) for column in J.T], axis=1)
    frames = np.zeros((len(views.frames), count + 1))
    for end in (0, 1):
        np.add.at(frames, views.ends[:, end], scores)
    spread = np.maximum(frames.T @ frames - scores.T @ scores, 0) * np.eye(count + 1) + scores.T @ scores
    inverse = np.linalg.inv(curvature)
    return step[:count], (inverse @ spread @ inverse)[:count, :count]

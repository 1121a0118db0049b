"""The tube that a lumen is in the large: its axis, centre and radius, from the normals of what was measured.

The normals of a tube are across its axis, and point to its centre: from a strip of it they tell both, as no
extrapolation of the surface itself would.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from endotwin.surface import Surface
from endotwin.surface.vectors import frame_along

VERTICES = 20_000
"""That are fitted; more say no more of six numbers."""

ROUNDS = 10
"""Of reweighting: folds and bends are no part of a tube."""


@dataclass(frozen=True)
class Tube:
    """A tube about the line through ``centre_mm`` [3] along the unit ``axis`` [3], in the surface's frame."""

    axis: np.ndarray
    centre_mm: np.ndarray
    radius_mm: float

    @cached_property
    def _across(self) -> np.ndarray:
        """Two unit vectors across the axis and each other, columns of [3, 2]."""
        return frame_along(self.axis)[:2].T

    def holds(self, points_mm: np.ndarray) -> bool:
        """Whether more than half of the points [N, 3] lie within."""
        across_mm = (points_mm - self.centre_mm) @ self._across
        return float(np.median(np.linalg.norm(across_mm, axis=1))) < self.radius_mm

    def points(
        self, between_mm: np.ndarray, beyond_mm: float, spacing_mm: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Points float32 [P, 3] on it from ``beyond_mm`` before all of ``between_mm`` [N, 3] to as far behind
        them, with round ends, and unit normals to its inside."""
        along_mm = (between_mm - self.centre_mm) @ self.axis
        low_mm, high_mm = along_mm.min() - beyond_mm, along_mm.max() + beyond_mm
        angle = np.arange(0.5 * spacing_mm / self.radius_mm, np.pi / 2, spacing_mm / self.radius_mm)
        middle_mm = np.arange(low_mm, high_mm, spacing_mm)
        slope = np.concatenate([-np.cos(angle), np.zeros(len(middle_mm)), np.cos(angle)])
        start_mm = np.concatenate([np.full(len(angle), low_mm), middle_mm, np.full(len(angle), high_mm)])
        found = []
        for at_mm, sine in zip(start_mm, slope, strict=True):
            cosine = np.sqrt(1 - sine * sine)
            count = max(3, round(2 * np.pi * self.radius_mm * cosine / spacing_mm))
            turn = 2 * np.pi * np.arange(count) / count
            outward = cosine * np.stack([np.cos(turn), np.sin(turn)], axis=1) @ self._across.T
            outward = outward + sine * self.axis
            found.append((self.centre_mm + at_mm * self.axis + self.radius_mm * outward, -outward))
        points_mm, normals = (np.concatenate(each).astype(np.float32) for each in zip(*found, strict=True))
        return points_mm, normals


def tube_of(surface: Surface) -> Tube | None:
    """The tube of a ``surface`` whose normals point inside; None: it is nothing like one, or only seen from
    outside.

    The axis is the direction that the normals are across of; the centre c, across it, and the radius R are
    those with p + R·n = c for vertices p and their normals n. Both by least squares, reweighted as Cauchy's.
    """
    chosen = slice(None, None, max(1, len(surface.vertices_mm) // VERTICES))
    vertices_mm, normals = (
        each[chosen].astype(np.float64) for each in (surface.vertices_mm, surface.normals)
    )
    weight = np.ones(len(normals))
    for _ in range(ROUNDS):
        axis = np.linalg.eigh((normals * weight[:, None]).T @ normals)[1][:, 0]
        weight = _trust(normals @ axis)
    across = frame_along(axis)[:2].T
    flat_mm, towards = vertices_mm @ across, normals @ across
    columns = np.stack([np.ones_like(towards), np.zeros_like(towards), -towards], axis=2)
    columns[:, 1, :2] = 0, 1
    trust = weight
    for _ in range(ROUNDS):
        by_row = columns * trust[:, None, None]
        normal = np.einsum("nik,nil->kl", by_row, columns)
        x, y, radius_mm = np.linalg.lstsq(normal, np.einsum("nik,ni->k", by_row, flat_mm), rcond=1e-9)[0]
        missed_mm = np.linalg.norm(columns @ (x, y, radius_mm) - flat_mm, axis=1)
        trust = weight * _trust(missed_mm)
    if not np.median(missed_mm) < radius_mm < np.ptp(surface.vertices_mm, axis=0).max():
        return None
    return Tube(axis, across @ (x, y), float(radius_mm))


def _trust(error: np.ndarray) -> np.ndarray:
    """Weights [N] of Cauchy's loss, as wide as the median size of the errors [N]."""
    return 1 / (1 + (error / max(float(np.median(np.abs(error))), 1e-9)) ** 2)

"""The tube that a lumen is in the large: its centre line, which bends, and radius, from the normals of what
was measured.

The normals of a tube are across its centre line, and point to it: from a strip of it they tell both, as no
extrapolation of the surface itself would.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from endotwin.surface import Surface
from endotwin.surface.vectors import frame_along, unit

VERTICES = 20_000
"""That are fitted; more say no more of nine numbers."""

ROUNDS = 10
"""Of reweighting: folds are no part of a tube."""

BEND = 0.2
"""Usual curvature of a colon's centre line, in 1 / radius (standard deviation)."""

POWERS = np.arange(3)
"""Of the way along the axis: the centre line is a parabola."""


@dataclass(frozen=True)
class Tube:
    """A tube in the surface's frame.

    Attributes:
        axis: unit vector [3] along it in the large. line_mm: [3, 3], its centre line is their sum times
            1, t and t², t in mm along the axis from line_mm[0].
    """

    axis: np.ndarray
    line_mm: np.ndarray
    radius_mm: float

    def along_mm(self, points_mm: np.ndarray) -> np.ndarray:
        """t [N] of points [N, 3]."""
        return (points_mm - self.line_mm[0]) @ self.axis

    def centre(self, along_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points [N, 3] of the centre line at t [N], and its unit tangents."""
        centre_mm = _powers(along_mm) @ self.line_mm
        return centre_mm, unit((POWERS[1:] * _powers(along_mm)[:, :-1]) @ self.line_mm[1:])

    def holds(self, points_mm: np.ndarray) -> bool:
        """Whether more than half of the points [N, 3] lie within."""
        centre_mm, tangent = self.centre(self.along_mm(points_mm))
        aside_mm = np.linalg.norm(np.cross(points_mm - centre_mm, tangent), axis=1)
        return float(np.median(aside_mm)) < self.radius_mm

    def points(
        self, between_mm: np.ndarray, beyond_mm: float, spacing_mm: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Points float32 [P, 3] on it from ``beyond_mm`` before all of ``between_mm`` [N, 3] to as far behind
        them, with round ends, and unit normals to its inside."""
        along_mm = self.along_mm(between_mm)
        low_mm, high_mm = along_mm.min() - beyond_mm, along_mm.max() + beyond_mm
        angle = np.arange(0.5 * spacing_mm / self.radius_mm, np.pi / 2, spacing_mm / self.radius_mm)
        middle_mm = np.arange(low_mm, high_mm, spacing_mm)
        slope = np.concatenate([-np.cos(angle), np.zeros(len(middle_mm)), np.cos(angle)])
        start_mm = np.concatenate([np.full(len(angle), low_mm), middle_mm, np.full(len(angle), high_mm)])
        centre_mm, tangent = self.centre(start_mm)
        found = []
        for at_mm, frame, sine in zip(centre_mm, frame_along(tangent), slope, strict=True):
            cosine = np.sqrt(1 - sine * sine)
            count = max(3, round(2 * np.pi * self.radius_mm * cosine / spacing_mm))
            turn = 2 * np.pi * np.arange(count) / count
            around = cosine * np.stack([np.cos(turn), np.sin(turn)], axis=1)
            outward = around @ frame[:2] + sine * frame[2]
            found.append((at_mm + self.radius_mm * outward, -outward))
        points_mm, normals = (np.concatenate(each).astype(np.float32) for each in zip(*found, strict=True))
        return points_mm, normals


def tube_of(surface: Surface) -> Tube | None:
    """The tube of a ``surface`` whose normals point inside; None: it is nothing like one, or only seen from
    outside.

    The axis is the direction that the normals are across of; centre line c and radius R are those with
    p + R·n = c(t) for vertices p and their normals n, t being how far along the axis p + R·n is. Both by
    least squares, reweighted as Cauchy's, beside what is usual of BEND. Over a piece as long as R, what is no
    tube is off alike: as many measures tell of the bend as there are such pieces.
    """
    chosen = slice(None, None, max(1, len(surface.vertices_mm) // VERTICES))
    vertices_mm, normals = (
        each[chosen].astype(np.float64) for each in (surface.vertices_mm, surface.normals)
    )
    axis = _axis(normals)
    across, start_mm = frame_along(axis)[:2].T, np.mean(vertices_mm @ axis)
    flat_mm, towards = vertices_mm @ across, normals @ across
    length_mm = float(np.ptp(vertices_mm @ axis))
    if length_mm == 0:
        return None
    columns = np.zeros((len(towards), 2, 2 * len(POWERS) + 1))
    columns[:, :, -1] = -towards
    radius_mm, stiff, trust = 0.0, 0.0, np.ones(len(normals))
    bends = np.arange(columns.shape[2]) % len(POWERS) == POWERS[-1]
    for _ in range(ROUNDS):
        powers = _powers(((vertices_mm + radius_mm * normals) @ axis - start_mm) / length_mm)
        columns[:, 0, : len(POWERS)] = columns[:, 1, len(POWERS) : -1] = powers
        by_row = columns * trust[:, None, None]
        normal = np.einsum("nik,nil->kl", by_row, columns) + np.diag(stiff * bends)
        found_mm = np.linalg.lstsq(normal, np.einsum("nik,ni->k", by_row, flat_mm), rcond=1e-9)[0]
        missed_mm = np.linalg.norm(columns @ found_mm - flat_mm, axis=1)
        radius_mm, trust = float(found_mm[-1]), _trust(missed_mm)
        by_bend = 2 * radius_mm / (BEND * length_mm**2)
        stiff = trust.sum() * abs(radius_mm) / length_mm * (by_bend * np.median(missed_mm)) ** 2
    if not np.median(missed_mm) < radius_mm < np.ptp(surface.vertices_mm, axis=0).max():
        return None
    line_mm = (across @ found_mm[:-1].reshape(2, -1)).T / length_mm ** POWERS[:, None]
    line_mm[:2] += [[start_mm], [1.0]] * axis
    return Tube(axis, line_mm, radius_mm)


def _axis(normals: np.ndarray) -> np.ndarray:
    """The unit direction [3] that most ``normals`` [N, 3] are across of."""
    trust = np.ones(len(normals))
    for _ in range(ROUNDS):
        axis = np.linalg.eigh((normals * trust[:, None]).T @ normals)[1][:, 0]
        trust = _trust(normals @ axis)
    return axis


def _powers(along: np.ndarray) -> np.ndarray:
    """[N, 3] of t [N]."""
    return along[:, None] ** POWERS


def _trust(error: np.ndarray) -> np.ndarray:
    """Weights [N] of Cauchy's loss, as wide as the median size of the errors [N]."""
    return 1 / (1 + (error / max(float(np.median(np.abs(error))), 1e-9)) ** 2)

"""Walls with a closed form."""

from __future__ import annotations

import numpy as np

from independent.wall import Wall

COLUMNS = 64


def revolved(reach_mm: np.ndarray, along_mm: np.ndarray) -> Wall:
    """A wall around z, ``reach_mm`` [M] from it at heights ``along_mm`` [M]; its front is inside."""
    angle = 2 * np.pi * np.arange(COLUMNS) / COLUMNS
    x, y = (reach_mm[:, None] * turned for turned in (np.cos(angle), np.sin(angle)))
    return Wall(np.stack([x, y, along_mm[:, None] + 0 * x], axis=2))


def sphere(radius_mm: float) -> Wall:
    """A sphere about the origin."""
    polar = np.linspace(np.pi, 0, 33)
    return revolved(radius_mm * np.sin(polar), radius_mm * np.cos(polar))


def disc(radius_mm: float, at_mm: float) -> Wall:
    """A disc across z at ``at_mm``, seen from below."""
    reach_mm = np.linspace(radius_mm, 0, 33)
    return revolved(reach_mm, np.full(33, at_mm))


def diaphragm(radius_mm: float, hole_mm: float, at_mm: float, length_mm: float) -> Wall:
    """A tube from z = −1 mm on, closed at ``length_mm``, with a thin ring that leaves a hole at ``at_mm``."""
    thin_mm = 0.05
    along_mm = np.array([-1, at_mm, at_mm + thin_mm / 2, at_mm + thin_mm, length_mm, length_mm])
    reach_mm = np.array([radius_mm, radius_mm, hole_mm, radius_mm, radius_mm, 0])
    return revolved(reach_mm, along_mm)

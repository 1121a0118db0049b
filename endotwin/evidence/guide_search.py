"""Where the light guides stand: the positions about the lens that predict held-out pixels best."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from endotwin.evidence.probe import Fitted, Hypothesis, Probe

RING = 0.12
"""Radius of the ring on which guides are first sought, as a share of the median viewing distance: a tip
that sees the wall at 20 mm has its guides within some 4 mm."""

RING_RADII = (0.5, 1.0)
RING_POINTS = 8
MOST_GUIDES = 3
REFINE_STEPS, SPREAD = 90, 0.2
POLISH_STEPS, POLISH_SPREAD = 30, 0.05
TOLERANCE = 1e-3
"""The search ends when positions move by less than this share of the ring's radius, and the loss by less."""


def ring_mm(probe: Probe, share: float = 1.0) -> np.ndarray:
    """Positions about the lens, float32 [RING_POINTS, 3]."""
    radius_mm = share * RING * float(np.exp(np.median(probe.samples.log_distance.numpy())))
    angle = 2 * np.pi * np.arange(RING_POINTS) / RING_POINTS
    return (radius_mm * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)).astype(np.float32)


def shadow_columns(probe: Probe) -> np.ndarray:
    """What each guide on the inner ring would leave in shadow, [N, RING_POINTS]: the trace of an offset.

    A guide farther out shades all of that, and more.
    """
    ring = ring_mm(probe, RING_RADII[0])
    return np.stack([~probe.visible(guide) for guide in ring], axis=1).astype(np.float64)


class Search:
    """Guide positions that predict a probe's pixels best, shadows included."""

    def __init__(self, probe: Probe, base: Fitted):
        self._probe, self._base = probe, base
        self._candidates = np.concatenate([ring_mm(probe, share) for share in RING_RADII])
        seen = [probe.visible(guide) for guide in self._candidates]
        self._at_risk = np.flatnonzero(~np.logical_and.reduce(seen))
        self._radius_mm = float(np.abs(self._candidates).max())

    def best(self, fewer: Hypothesis | None) -> Hypothesis:
        """The best hypothesis with one guide more than ``fewer``, which None is the light at the lens."""
        known = np.empty((0, 3), np.float32) if fewer is None else np.asarray(fewer.guides_mm, np.float32)
        joined = [np.vstack([known, candidate]) for candidate in self._candidates]
        return self._refined(min(joined, key=self._loss), REFINE_STEPS, SPREAD)

    def polished(self) -> Hypothesis:
        """The base with its own guides moved to where they predict best beside all that was kept since."""
        base = self._base.hypothesis
        refined = self._refined(np.asarray(base.guides_mm), POLISH_STEPS, POLISH_SPREAD)
        return replace(refined, shadows=base.shadows)

    def _refined(self, start_mm: np.ndarray, steps: int, spread: float) -> Hypothesis:
        """Guides moved from ``start_mm`` [K, 3] by ``steps`` trials each, first by ``spread`` of the ring."""
        first = start_mm[:, :2].astype(np.float64).ravel() / self._radius_mm
        found = minimize(
            lambda x: self._loss(self._guides(x)),
            first,
            method="Nelder-Mead",
            options={
                "maxfev": steps * len(start_mm),
                "xatol": TOLERANCE,
                "fatol": TOLERANCE * self._loss(self._guides(first)),
                "initial_simplex": np.vstack([first, first + spread * np.eye(len(first))]),
            },
        )
        return self._with(self._guides(found.x))

    def _guides(self, x: np.ndarray) -> np.ndarray:
        return np.c_[x.reshape(-1, 2), np.zeros(len(x) // 2)].astype(np.float32) * np.float32(self._radius_mm)

    def _loss(self, guides_mm: np.ndarray) -> float:
        visible = np.ones((len(self._probe), len(guides_mm)), bool)
        for k, guide in enumerate(guides_mm):
            visible[self._at_risk, k] = self._probe.visible(guide, self._at_risk)
        return self._fitted_loss(guides_mm, visible)

    def _fitted_loss(self, guides_mm: np.ndarray, visible: np.ndarray) -> float:
        return self._probe.loss(self._with(guides_mm), self._base, visible)

    def _with(self, guides_mm: np.ndarray) -> Hypothesis:
        guides = tuple(tuple(float(c) for c in guide) for guide in guides_mm)
        return replace(self._base.hypothesis, guides_mm=guides, shadows=True)

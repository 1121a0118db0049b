"""Albedo and roughness of tissue: mottling, and vessels along the level lines of smooth noise."""

from __future__ import annotations

import numpy as np

from independent.colon import smooth_noise

FINER = 2
"""Texels a cell of the wall's grid, each way."""


def mucosa(rng: np.random.Generator, shape: tuple[int, int], roughness: float) -> np.ndarray:
    """Linear RGB albedo and roughness, float32 [H, W, 4], of a wall with ``shape`` points.

    The scene draws how pale, mottled and finely grained its tissue is.
    """
    size = (FINER * (shape[0] - 1) + 1, FINER * shape[1])
    tissue = rng.uniform([0.50, 0.45, 0.65], [0.78, 0.62, 0.95])
    tissue = np.cumprod(tissue)
    mottled, grained, vessels = rng.uniform([0.04, 0.0, 0.1], [0.14, 0.06, 0.6])
    shade = mottled * smooth_noise(rng, size, rng.uniform(10, 40)) + grained * smooth_noise(rng, size, 1.5)
    blood = vessels * np.maximum(_network(rng, size, 24, 0.09), 0.7 * _network(rng, size, 10, 0.12))
    absorbed = np.array([0.35, 1.0, 0.8])
    albedo = tissue * np.exp(shade[..., None] * [0.6, 1.0, 1.0] - blood[..., None] * absorbed)
    rough = roughness * np.exp(0.15 * smooth_noise(rng, size, 20))
    return np.concatenate([np.clip(albedo, 0.02, 0.9), np.clip(rough, 0.2, 0.9)[..., None]], axis=2).astype(
        np.float32
    )


def _network(rng: np.random.Generator, size: tuple[int, int], blur: float, width: float) -> np.ndarray:
    """1 on the zero lines of a smooth field and 0 off them, with parts of the net left out."""
    lines = np.exp(-((smooth_noise(rng, size, blur) / width) ** 2))
    return lines / (1 + np.exp(-3 * smooth_noise(rng, size, 2 * blur)))

"""Lobes of a film by pixels: what vertices that share a triangle show together.

``glints`` finds the lobe of each vertex from means of the pixels about it, which are dimmer than a clipped
highlight and blunter than its edge. From there all lobes together go on with the pixels themselves, by
Gauss–Newton, damped as by Levenberg and Marquardt.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import LinearOperator, cg
from torch import Tensor

from endotwin.fit.beneath import Based
from endotwin.fit.glints import LEAST_TOLD, PRECISION, Glints, Lobes, missed, pairs_in

STEPS, DAMPING, LESS, MORE = 10, 0.1, 0.5, 3.0
"""Of the descent: steps, the damping at first, and factors on it after a better step and after a worse."""

SOLVED, PRODUCTS = 1e-2, 50
"""A step is as exact as this, or takes so many products."""


class _Shown(NamedTuple):
    """What lobes show: slopes [P, 3] of the pairs' film, errors and slopes of the pixels by film [N, 3], and
    the cost of it all."""

    slopes: Tensor
    error: Tensor
    by_film: Tensor
    cost: float


def by_pixels(based: Based, glints: Glints, lobes: Lobes) -> Lobes:
    """The lobes that show the pixels ``based`` best, from ``lobes``, which show their means, ``glints``."""
    mix, photo = pairs_in(based, glints.vertex)[0].astype(np.float64), based.shown
    damping, shown = DAMPING, _shown(photo, based.radiance, glints, mix, lobes)
    for _ in range(STEPS):
        moved = lobes.moved(_step(glints, mix, lobes, shown, damping))
        tried = _shown(photo, based.radiance, glints, mix, moved)
        better = tried.cost < shown.cost
        if better:
            lobes, shown = moved, tried
        damping *= LESS if better else MORE
    return lobes


def _shown(photo: Tensor, radiance: Tensor, glints: Glints, mix: csr_array, lobes: Lobes) -> _Shown:
    """What ``lobes`` show on ``radiance`` [N, 3] of pixels of the display values ``photo`` [N, 3]."""
    film, slopes = lobes.linearised(glints)
    film = torch.from_numpy(mix @ film.double().numpy()).float()
    error, by_film = missed(photo, radiance, film, glints.gamma)
    cost = (error.double() ** 2).sum() + PRECISION * (glints.off(lobes).double() ** 2).sum()
    return _Shown(slopes, error, by_film, float(cost) / 2)


def _step(glints: Glints, mix: csr_array, lobes: Lobes, shown: _Shown, damping: float) -> Tensor:
    """Steps [M, 3] of the lobes' values that solve (JᵀJ + prior + damping·diagonal)·step = Jᵀe."""
    pairs, count = len(glints.of_vertex), 3 * len(glints.vertex)
    column = 3 * glints.of_vertex.numpy()[:, None] + np.arange(3)
    by_values = csr_array(
        (shown.slopes.double().numpy().ravel(), column.ravel(), np.arange(0, 3 * pairs + 1, 3)),
        shape=(pairs, count),
    )
    weight = (shown.by_film.double() ** 2).sum(dim=1).numpy()
    pull = by_values.T @ (mix.T @ (shown.by_film * shown.error).double().sum(dim=1).numpy())
    prior = np.zeros(count)
    prior[2::3] = PRECISION
    pull[2::3] -= PRECISION * glints.off(lobes).double().numpy()
    told = by_values.power(2).T @ (mix.power(2).T @ weight)  # a pixel has but one pair of each vertex
    diagonal = np.maximum((1 + damping) * (told + prior), LEAST_TOLD)

    def product(step: np.ndarray) -> np.ndarray:
        film = weight * (mix @ (by_values @ step))
        return by_values.T @ (mix.T @ film) + (diagonal - told) * step

    normal = LinearOperator((count, count), product, dtype=np.float64)
    step, _ = cg(normal, pull, rtol=SOLVED, maxiter=PRODUCTS, M=diags_array(1 / diagonal))
    return torch.from_numpy(step.reshape(-1, 3)).float()

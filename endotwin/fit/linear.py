"""Linear equations of a step: conjugate gradients, and the least cost beside a border of a few unknowns."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

CG_TOLERANCE = 1e-3
CG_STEPS = 25


def conjugate_gradients(
    product: Callable[[Tensor], Tensor],
    right: Tensor,
    inverse: Tensor,
    out_of_time: Callable[[], bool] = lambda: False,
    start: Tensor | None = None,
    tolerance: float = CG_TOLERANCE,
) -> tuple[Tensor, Tensor]:
    """Solve for all right-hand sides [R, C, K] at once, preconditioned by blocks ``inverse`` [R, C, C].

    Ended early, when ``out_of_time`` says so, it still gives a step that descends.

    Args:
        start: about what the solutions are, but for a factor each; None: not known.
        tolerance: ends when all residuals, as the preconditioner measures them, are smaller than right-hand
            sides by this factor.

    Returns:
        the solutions and their products with the matrix, [R, C, K].
    """
    x, residual = torch.zeros_like(right), right.clone()
    goal = tolerance**2 * (right * (inverse @ right)).sum(dim=(0, 1))
    if start is not None:
        image = product(start)
        length = (start * right).sum(dim=(0, 1)) / (start * image).sum(dim=(0, 1)).clamp_min(1e-30)
        x, residual = length * start, right - length * image
    z = inverse @ residual
    direction = z.clone()
    energy = (residual * z).sum(dim=(0, 1))
    for number in range(CG_STEPS):
        if (energy <= goal).all() or (number and out_of_time()):
            break
        image = product(direction)
        length = energy / (direction * image).sum(dim=(0, 1)).clamp_min(1e-30)
        x += length * direction
        residual -= length * image
        z = inverse @ residual
        renewed = (residual * z).sum(dim=(0, 1))
        direction = z + (renewed / energy.clamp_min(1e-30)) * direction
        energy = renewed
    return x, right - residual


def joint_minimum(
    basis: Tensor, image: Tensor, right: Tensor, shared_normal: np.ndarray, shared_right: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Minimise the bordered quadratic over the shared parameters and the span of ``basis``.

    With exact solutions as basis this is elimination by Schur complement; with truncated ones it still
    descends.

    Args:
        basis, image, right: [R, C, 1 + G]: solutions, their products with the matrix, right-hand sides, of
            which the first is the residual's and the others border the matrix.

    Returns:
        weights of the basis [1 + G]; shared step [G]; its covariance [G, G], the inverse of the Schur
        complement.
    """
    columns = basis.shape[2]
    flat = [x.reshape(-1, columns).double().cpu().numpy() for x in (basis, image, right)]
    inner, border = flat[0].T @ flat[1], flat[0].T @ flat[2]
    matrix = np.block([[inner, border[:, 1:]], [border[:, 1:].T, shared_normal]])
    solution = np.linalg.lstsq(matrix, np.r_[border[:, 0], shared_right], rcond=1e-12)[0]
    covariance = np.linalg.pinv(matrix, rcond=1e-12)[columns:, columns:]
    return solution[:columns], solution[columns:], covariance


def squared(matrix: Tensor) -> Tensor:
    """The CSR matrix with each entry squared."""
    return torch.sparse_csr_tensor(
        matrix.crow_indices(),
        matrix.col_indices(),
        matrix.values() ** 2,
        matrix.shape,
        check_invariants=False,
    )

"""Gains of frames beside vertex materials, eliminated from the normal equations of a step.

A gain scales one whole frame, so that among gains the normal matrix is diagonal, D. With the border B between
gains and all else, what is left of the equations is A − B·D⁻¹·Bᵀ (Schur complement). Gains are known up to
one factor, which is the light's: their logarithms' steps sum to 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from endotwin.fit.hashgrid import to_torch

RIDGE = 1e-6
"""Share of the largest entry of D that is added to all: a black frame's gain stays."""


class FramePattern:
    """Where a sample set lands in a matrix of vertices × frames.

    Args:
        corners: int [N, 3], vertices about each sample. row: int [N], its frame, below ``frames``.
        vertices: how many there are.
    """

    def __init__(self, corners: np.ndarray, row: np.ndarray, vertices: int, frames: int):
        key, entry = np.unique(corners.astype(np.int64) * frames + row[:, None], return_inverse=True)
        self.vertices, self.frames, self.row = vertices, frames, row
        self.entry, self.count = entry.reshape(corners.shape), len(key)
        self._vertex, self._frame = np.divmod(key, frames)

    def matrix(self, values: np.ndarray) -> scipy.sparse.csr_array:
        """CSR [C·V, F] of ``values`` [E, C] at the pattern's entries, a vertex' channels one after the
        other."""
        channels = values.shape[1]
        place = channels * self._vertex[:, None] + np.arange(channels)
        frame = np.broadcast_to(self._frame[:, None], place.shape)
        shape = (channels * self.vertices, self.frames)
        entries = (values.astype(np.float32).ravel(), (place.ravel(), frame.ravel()))
        return scipy.sparse.csr_array(scipy.sparse.coo_array(entries, shape=shape))


class FrameSums:
    """Sums over samples from which ``FrameBorder`` is made, chunk by chunk."""

    def __init__(self, pattern: FramePattern, channels: int, shared: int):
        self._pattern = pattern
        self._coupling = np.zeros((pattern.count, channels))
        self._columns = np.zeros((pattern.frames, 2 + shared))

    def add(self, rows: slice, corner: Tensor, by_gain: Tensor, channels: Tensor, others: Tensor) -> None:
        """Add samples ``rows``, N of them.

        Args:
            corner: barycentric [N, 3]. by_gain: slope by ln gain times its robust weight [N, 3]. channels:
                products of that with the slopes by the materials, [N, C]. others: slope by ln gain, error and
                slopes by the shared parameters, [N, 3, 2 + G].
        """
        row, entry = self._pattern.row[rows], self._pattern.entry[rows].ravel()
        shares = (corner[:, :, None] * channels[:, None]).flatten(0, 1).cpu().numpy()
        for total, column in zip(self._coupling.T, shares.T, strict=True):
            total += np.bincount(entry, column, len(total))
        products = (by_gain[..., None] * others).sum(dim=1).cpu().numpy()
        for total, column in zip(self._columns.T, products.T, strict=True):
            total += np.bincount(row, column, len(total))

    def border(self, device: torch.device) -> FrameBorder:
        coupling = self._pattern.matrix(self._coupling)
        diagonal = self._columns[:, 0] + max(RIDGE * self._columns[:, 0].max(), np.finfo(np.float32).tiny)
        inverse, columns = (
            torch.from_numpy(x).float().to(device) for x in (1 / diagonal, self._columns[:, 1:])
        )
        return FrameBorder(to_torch(coupling).to(device), to_torch(coupling.T).to(device), inverse, columns)


@dataclass(frozen=True)
class FrameBorder:
    """The border of F gains.

    Attributes:
        coupling: CSR [C·V, F], and its ``adjoint``. inverse: [F], 1/D. columns: [F, 1 + G], products with the
            error and the shared parameters.
    """

    coupling: Tensor
    adjoint: Tensor
    inverse: Tensor
    columns: Tensor

    def solve(self, right: Tensor) -> Tensor:
        """D⁻¹ [F, K] of ``right`` [F, K], among gains whose logarithms sum to 0."""
        inverse = self.inverse[:, None]
        free = inverse * right
        return free - inverse * (free.sum(dim=0) / inverse.sum())

    def product(self, values: Tensor) -> Tensor:
        """B·D⁻¹·Bᵀ times vertex values [V, C, K]."""
        flat = values.reshape(-1, values.shape[-1]).contiguous()
        return (self.coupling @ self.solve(self.adjoint @ flat)).reshape(values.shape)

    def right(self, shape: torch.Size) -> Tensor:
        """B·D⁻¹ times the columns, [V, C, 1 + G], which is ``shape``."""
        return (self.coupling @ self.solve(self.columns)).reshape(shape)

    def shared(self) -> np.ndarray:
        """Columns times D⁻¹ times columns, [1 + G, 1 + G]."""
        return (self.columns.T @ self.solve(self.columns)).double().cpu().numpy()

    def step(self, vertex: Tensor, shared: np.ndarray) -> np.ndarray:
        """Steps of the gains' logarithms float64 [F], beside steps [V, C] of the vertices and [G] of what is
        shared."""
        beside = torch.from_numpy(np.r_[1.0, -shared]).to(self.columns)
        left = self.columns @ beside - (self.adjoint @ vertex.reshape(-1, 1))[:, 0]
        return self.solve(left[:, None])[:, 0].double().cpu().numpy()

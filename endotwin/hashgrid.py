"""Multiresolution hash features at fixed points, as one sparse linear operator.

Instant-NGP (Müller et al. 2022, sec. 3) interpolates, at each point and level, the features of the eight
corners of the grid cell around it, looked up in a table by a spatial hash. The vertices of a surface do not
move, so neither do corners and weights: all of it is a sparse matrix A with features = A·table, whose
transpose carries gradients back.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta state")
warnings.filterwarnings("ignore", message="Sparse invariant checks are implicitly disabled")

PRIMES = (1, 2_654_435_761, 805_459_861)
"""Factors of the spatial hash, one a dimension (Müller et al. 2022, eq. 4)."""

HASH_ORIGIN = -100_003
"""Corner that is hashed as (0, 0, 0), far from any scene and off the hash's period of 2**log2_slots. About
it corners
collide with their mirror images, since in two's complement −a ^ −b = a ^ b for odd a and b."""

CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])


@dataclass(frozen=True)
class HashGrid:
    """The shape of a multiresolution grid.

    Attributes:
        coarsest_mm, finest_mm: cell edge of the first level and bound on that of the last.
        growth: ratio of the cell edges of successive levels, > 1.
        log2_slots: a level with more occupied corners than 2**log2_slots shares slots by the hash.
    """

    coarsest_mm: float
    finest_mm: float
    growth: float = 1.5
    log2_slots: int = 19

    @property
    def cells_mm(self) -> np.ndarray:
        """Cell edge of each level, coarse to fine, float64 [levels]."""
        levels = 1 + max(
            0, int(np.floor(np.log(self.coarsest_mm / self.finest_mm) / np.log(self.growth) + 1e-9))
        )
        return self.coarsest_mm / self.growth ** np.arange(levels)


def corner_slots(points_mm: np.ndarray, cell_mm: float, log2_slots: int) -> tuple[np.ndarray, np.ndarray]:
    """Slot and trilinear weight of the eight cell corners around each point, at one level.

    Args:
        points_mm: float [V, 3].

    Returns:
        slot int64 [V, 8], below 2**log2_slots; weight float64 [V, 8], non-negative, summing to 1.
    """
    scaled = np.asarray(points_mm, np.float64) / cell_mm
    base = np.floor(scaled).astype(np.int64)
    inside = (scaled - base)[:, None, :]
    weight = np.where(CORNERS, inside, 1 - inside).prod(axis=2)
    corner = base[:, None, :] + CORNERS - HASH_ORIGIN
    mixed = corner[..., 0] * PRIMES[0] ^ corner[..., 1] * PRIMES[1] ^ corner[..., 2] * PRIMES[2]
    return mixed & ((1 << log2_slots) - 1), weight


@dataclass(frozen=True)
class HashOperator:
    """The sparse operator A of V points and a table of R rows.

    Only slots that some point uses have a row in the table.

    Attributes:
        forward_csr: A, torch sparse CSR float32 [V, R]. adjoint_csr: Aᵀ, [R, V].
        level, slot: int64 [R], level and hash slot of each row, ascending. cells_mm: float64 [levels].
    """

    forward_csr: Tensor
    adjoint_csr: Tensor
    level: np.ndarray
    slot: np.ndarray
    cells_mm: np.ndarray

    @classmethod
    def of(cls, points_mm: np.ndarray, grid: HashGrid) -> HashOperator:
        """The operator of ``grid`` at points float [V, 3]."""
        columns, weights, level, slots, rows = [], [], [], [], 0
        for number, cell_mm in enumerate(grid.cells_mm):
            slot, weight = corner_slots(points_mm, cell_mm, grid.log2_slots)
            occupied = np.zeros(1 << grid.log2_slots, bool)
            occupied[slot] = True
            used = np.flatnonzero(occupied)
            columns.append((np.cumsum(occupied) - 1)[slot] + rows)
            weights.append(weight)
            level.append(np.full(len(used), number))
            slots.append(used)
            rows += len(used)
        columns, weights = np.concatenate(columns, axis=1), np.concatenate(weights, axis=1)
        starts = np.arange(0, columns.size + 1, columns.shape[1])
        matrix = scipy.sparse.csr_matrix(
            (weights.ravel().astype(np.float32), columns.ravel(), starts), (len(points_mm), rows)
        )
        return cls(
            to_torch(matrix), to_torch(matrix.T), np.concatenate(level), np.concatenate(slots), grid.cells_mm
        )

    def __call__(self, table: Tensor) -> Tensor:
        """Features [V, C] = A·table [R, C], differentiable; the gradient is Aᵀ·g."""
        return _Apply.apply(table, self)

    def adopt(self, table: Tensor, other: HashOperator) -> Tensor:
        """The entries of ``other``'s table [R', C] in this operator's rows [R, C]; 0 where ``other`` has
        none.
        """
        stride = 1 + max(int(self.slot.max()), int(other.slot.max()))
        mine, theirs = self.level * stride + self.slot, other.level * stride + other.slot
        _, here, there = np.intersect1d(mine, theirs, assume_unique=True, return_indices=True)
        adopted = torch.zeros(len(mine), table.shape[1], dtype=table.dtype)
        adopted[torch.from_numpy(here)] = table[torch.from_numpy(there)]
        return adopted


class _Apply(torch.autograd.Function):
    @staticmethod
    def forward(ctx, table: Tensor, operator: HashOperator) -> Tensor:
        ctx.operator = operator
        return operator.forward_csr @ table

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, None]:
        return ctx.operator.adjoint_csr @ gradient.contiguous(), None


def to_torch(matrix) -> Tensor:
    """A scipy CSR matrix as a torch sparse CSR tensor, float32."""
    matrix = matrix.tocsr()
    return torch.sparse_csr_tensor(
        torch.from_numpy(matrix.indptr.astype(np.int64)),
        torch.from_numpy(matrix.indices.astype(np.int64)),
        torch.from_numpy(matrix.data.astype(np.float32)),
        matrix.shape,
        check_invariants=False,
    )

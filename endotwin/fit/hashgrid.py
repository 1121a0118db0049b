"""Multiresolution hash features at fixed points, as one sparse linear operator.

Instant-NGP (Müller et al. 2022, sec. 3) interpolates, at each point and level, the features of the eight
corners of the grid cell around it, looked up in a table by a spatial hash. The vertices of a surface do not
move, so neither do corners and weights: all of it is a sparse matrix A with features = A·table, whose
transpose carries gradients back.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from endotwin.run.ahead import on_all_cores

warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta state")
warnings.filterwarnings("ignore", message="Sparse invariant checks are implicitly disabled")

PRIMES = (1, 2_654_435_761, 805_459_861)
"""Factors of the spatial hash, one a dimension (Müller et al. 2022, eq. 4)."""

HASH_ORIGIN = -100_003
"""Corner that is hashed as (0, 0, 0), far from any scene and off the hash's period of 2**log2_slots. About it
corners collide with their mirror images, since in two's complement −a ^ −b = a ^ b for odd a and b."""


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
    scaled = np.asarray(points_mm, np.float64).T / cell_mm
    base = np.floor(scaled)
    inside = scaled - base
    low = base.astype(np.int64) - HASH_ORIGIN
    x, y, z = (np.stack([c * prime, (c + 1) * prime], axis=1) for c, prime in zip(low, PRIMES, strict=True))
    mixed = (x[:, :, None, None] ^ y[:, None, :, None]) ^ z[:, None, None, :]
    x, y, z = (np.stack([1 - t, t], axis=1) for t in inside)
    weight = (x[:, :, None, None] * y[:, None, :, None]) * z[:, None, None, :]
    return mixed.reshape(-1, 8) & ((1 << log2_slots) - 1), weight.reshape(-1, 8)


def level_slots(points_mm: Tensor, cells_mm: np.ndarray, log2_slots: int) -> tuple[Tensor, Tensor]:
    """``corner_slots`` of several levels on the points' device, a table behind the other.

    Args:
        points_mm: float64 [N, 3].

    Returns:
        slot int64 [N, L, 8], of level l from l·2**log2_slots on; weight float32 [N, L, 8].
    """
    cells = torch.as_tensor(cells_mm, dtype=torch.float64, device=points_mm.device)
    mixed, weight = [0] * 8, [1.0] * 8
    for axis, prime in enumerate(PRIMES):
        scaled = points_mm[:, axis, None] / cells
        base = torch.floor(scaled)
        inside = (scaled - base).float()
        low = (base.long() - HASH_ORIGIN) * prime
        hashed, shares = (low, low + prime), (1 - inside, inside)
        for corner in range(8):
            side = corner >> (2 - axis) & 1
            mixed[corner] = mixed[corner] ^ hashed[side]
            weight[corner] = weight[corner] * shares[side]
    first = torch.arange(len(cells), device=points_mm.device) << log2_slots
    slots = [(each & ((1 << log2_slots) - 1)) + first for each in mixed]
    return torch.stack(slots, dim=2), torch.stack(weight, dim=2)


@dataclass(frozen=True)
class HashOperator:
    """The sparse operator A of V points and a table of R rows.

    Only slots that some point uses have a row in the table.

    Attributes:
        forward_csr: A, torch sparse CSR float32 [V, R].
        level, slot: int64 [R], level and hash slot of each row, ascending. cells_mm: float64 [levels].
    """

    forward_csr: Tensor
    level: np.ndarray
    slot: np.ndarray
    cells_mm: np.ndarray
    log2_slots: int

    @classmethod
    def of(cls, points_mm: np.ndarray, grid: HashGrid) -> HashOperator:
        """The operator of ``grid`` at points float [V, 3]."""

        def one(cell_mm: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            slot, weight = corner_slots(points_mm, cell_mm, grid.log2_slots)
            occupied = np.zeros(1 << grid.log2_slots, bool)
            occupied[slot] = True
            row = np.cumsum(occupied, dtype=np.int32) - 1
            return row[slot], weight.astype(np.float32), np.flatnonzero(occupied)

        columns, weights, slots = zip(*on_all_cores(one, grid.cells_mm), strict=True)
        first = np.cumsum([0, *map(len, slots)], dtype=np.int32)
        placed = [each + start for each, start in zip(columns, first[:-1], strict=True)]
        columns, weights = np.concatenate(placed, axis=1), np.concatenate(weights, axis=1)
        starts, shape = np.arange(0, columns.size + 1, columns.shape[1]), (len(points_mm), first[-1])
        return cls(
            to_torch(scipy.sparse.csr_matrix((weights.ravel(), columns.ravel(), starts), shape)),
            np.repeat(np.arange(len(slots)), np.diff(first)),
            np.concatenate(slots),
            grid.cells_mm,
            grid.log2_slots,
        )

    @classmethod
    def each(cls, count: int, cell_mm: float) -> HashOperator:
        """The identity: each of ``count`` points has a row of its own, as in a cell of edge ``cell_mm``."""
        one = to_torch(scipy.sparse.identity(count, np.float32, "csr"))
        return cls(one, np.zeros(count, np.int64), np.arange(count), np.array([cell_mm]), 0)

    def to(self, device: torch.device) -> HashOperator:
        """The same operator, its matrices on ``device``."""
        return replace(self, forward_csr=self.forward_csr.to(device))

    def of_points(self, points: np.ndarray) -> HashOperator:
        """The operator of some of its points, int [N], and the same table."""
        return replace(self, forward_csr=to_torch(_to_scipy(self.forward_csr)[points]))

    @cached_property
    def adjoint_csr(self) -> Tensor:
        """Aᵀ, [R, V]."""
        return to_torch(_to_scipy(self.forward_csr.cpu()).T).to(self.forward_csr.device)

    def __call__(self, table: Tensor) -> Tensor:
        """Features [V, C] = A·table [R, C]."""
        return self.forward_csr @ table

    def at(self, points_mm: np.ndarray, table: Tensor) -> Tensor:
        """Features [V, C] of ``table`` [R, C] at other points [V, 3]; a slot that has no row counts as 0."""
        features = torch.zeros(len(points_mm), table.shape[1])
        for number, cell_mm in enumerate(self.cells_mm):
            rows = np.flatnonzero(self.level == number)
            dense = torch.zeros(1 << self.log2_slots, table.shape[1])
            dense[torch.from_numpy(self.slot[rows])] = table[torch.from_numpy(rows)]
            slot, weight = corner_slots(points_mm, cell_mm, self.log2_slots)
            features += torch.nn.functional.embedding_bag(
                torch.from_numpy(slot), dense, mode="sum", per_sample_weights=torch.from_numpy(weight).float()
            )
        return features


def to_torch(matrix) -> Tensor:
    """A scipy CSR matrix as a torch sparse CSR tensor, float32.

    With indices of 32 bits MKL multiplies four times as fast as with those of 64.
    """
    matrix = matrix.tocsr()
    kind = np.int32 if max(matrix.nnz, *matrix.shape) < 2**31 else np.int64
    return torch.sparse_csr_tensor(
        torch.from_numpy(matrix.indptr.astype(kind)),
        torch.from_numpy(matrix.indices.astype(kind)),
        torch.from_numpy(matrix.data.astype(np.float32)),
        matrix.shape,
        check_invariants=False,
    )


def _to_scipy(matrix: Tensor) -> scipy.sparse.csr_matrix:
    """A torch sparse CSR tensor on the CPU as a scipy matrix of the same memory."""
    parts = matrix.values(), matrix.col_indices(), matrix.crow_indices()
    return scipy.sparse.csr_matrix(tuple(part.numpy() for part in parts), tuple(matrix.shape))

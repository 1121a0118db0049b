"""Matrices over the vertices that photos tell of, summed over pixels.

Each pixel touches the three vertices of its triangle, so that these matrices have the sparsity of the mesh.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from endotwin.pixels.samples import Samples

CORNER_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))

Places = tuple[tuple[int, ...], ...]
"""[C, C], symmetric: which of K sums are those of two channels; below 0: none are."""


class MeshPattern:
    """Where the products of a sample set land.

    Attributes:
        told: bool [vertex_count], corners of triangles that samples show. vertices: int64 [V], which these
            are, ascending.
        corners: int [T, 3], of those triangles, numbers of ``vertices``. compact: int [N], the triangle of
            each sample.
    """

    def __init__(self, samples: Samples, triangles: np.ndarray, vertex_count: int):
        hit, self.compact = np.unique(samples.triangle.numpy(), return_inverse=True)
        told = np.zeros(vertex_count, bool)
        told[triangles[hit]] = True
        self.told, self.vertices = torch.from_numpy(told), np.flatnonzero(told)
        self.corners = (np.cumsum(told) - 1)[triangles[hit]]
        count = len(self.vertices)
        both = [(k, *pair) for k, (i, j) in enumerate(CORNER_PAIRS) for pair in sorted({(i, j), (j, i)})]
        entry = np.concatenate([len(CORNER_PAIRS) * np.arange(len(hit)) + k for k, _, _ in both])
        key = np.concatenate([self.corners[:, i] * count + self.corners[:, j] for _, i, j in both])
        order = np.argsort(key, kind="stable")
        key, entry = key[order], entry[order].astype(np.int32)
        first = np.flatnonzero(np.r_[True, key[1:] != key[:-1]][: len(key)])
        self._row, self._column = np.divmod(key[first], max(1, count))
        shape = (len(first), len(CORNER_PAIRS) * len(hit))
        ones = np.ones(len(entry), np.float32)
        self._summed = scipy.sparse.csr_array((ones, entry, np.r_[first, len(entry)]), shape=shape)
        self._layouts: dict[Places, tuple[Tensor, Tensor, Tensor]] = {}

    def matrix(self, pair_sums: np.ndarray, places: Places) -> Tensor:
        """Symmetric CSR [C·V, C·V], a vertex' channels one after the other, from K sums [T, 6, K] of weighted
        products of barycentrics, by CORNER_PAIRS."""
        sums = self._summed @ pair_sums.reshape(-1, pair_sums.shape[2])
        if places not in self._layouts:
            self._layouts[places] = self._laid_out(places)
        pointers, columns, source = self._layouts[places]
        data = torch.from_numpy(sums.astype(np.float32, copy=False)).reshape(-1)[source]
        shape = (len(pointers) - 1,) * 2
        return torch.sparse_csr_tensor(pointers, columns, data, shape, check_invariants=False)

    def vector(self, corner_sums: np.ndarray) -> np.ndarray:
        """Vertex sums [V, C] from triangle corner sums [T, 3, C]."""
        flat = corner_sums.reshape(-1, corner_sums.shape[2])
        ids, count = self.corners.reshape(-1), len(self.vertices)
        return np.stack([np.bincount(ids, column, count) for column in flat.T], axis=1)

    def _laid_out(self, places: Places) -> tuple[Tensor, Tensor, Tensor]:
        """Of ``matrix`` int32 pointers and columns, and from which of the sums each entry is."""
        channels, kinds = len(places), 1 + max(map(max, places))
        meets = [[b for b, place in enumerate(row) if place >= 0] for row in places]
        neighbours = np.bincount(self._row, minlength=len(self.vertices))
        lengths = np.stack([neighbours * len(each) for each in meets], axis=1)
        pointers = np.r_[0, np.cumsum(lengths)]
        within = np.arange(len(self._row)) - (np.cumsum(neighbours) - neighbours)[self._row]
        columns, source = (np.empty(pointers[-1], np.int32) for _ in range(2))
        for a, others in enumerate(meets):
            begins = pointers[channels * self._row + a] + within * len(others)
            for number, b in enumerate(others):
                columns[begins + number] = channels * self._column + b
                source[begins + number] = kinds * np.arange(len(self._row)) + places[a][b]
        return tuple(map(torch.from_numpy, (pointers.astype(np.int32), columns, source)))


def lumped(matrix: Tensor, channels: int) -> Tensor:
    """Row sums of a CSR [C·V, C·V] as one block a vertex, [V, C, C]."""
    ones = torch.eye(channels, device=matrix.device).repeat(len(matrix) // channels, 1)
    return (matrix @ ones).reshape(-1, channels, channels)


def pairs_of(corner: Tensor) -> Tensor:
    """Products of barycentrics [N, 3] by CORNER_PAIRS, [N, 6]."""
    first, second = np.transpose(CORNER_PAIRS)
    return corner[:, first] * corner[:, second]

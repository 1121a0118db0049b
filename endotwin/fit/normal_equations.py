"""Normal equations of one Gauss–Newton step over vertex materials and shared parameters.

The normal matrix has the sparsity of the mesh (``mesh_pattern``). Base colours of different channels do not
meet; roughness meets all three. Shared parameters border it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from endotwin.fit.frame_gains import FrameBorder, FramePattern, FrameSums
from endotwin.fit.mesh_pattern import CORNER_PAIRS, MeshPattern, lumped, pairs_of
from endotwin.fit.model import Globals, at_pixels, columns_of, linearise
from endotwin.pixels.samples import CLIPPED, Samples
from endotwin.pixels.start import DIFFUSE_SIN2
from endotwin.run.ahead import on_all_cores

CHANNELS = 4
"""Base colour red, green, blue; roughness."""

PLACES = ((0, -1, -1, 3), (-1, 1, -1, 4), (-1, -1, 2, 5), (3, 4, 5, 6))
"""Which of the sums of ``_Products.pairs`` are those of two channels: base colours do not meet."""

CHUNK = 1 << 16


@dataclass(frozen=True)
class Residual:
    """Photo minus prediction at N samples [N, 3] and its robust weight [N, 3].

    A clipped photo says "at least": where the prediction is brighter, residual and weight are 0.
    """

    error: Tensor
    weight: Tensor

    @classmethod
    def of(cls, samples: Samples, predicted: Tensor, width: float) -> Residual:
        """Pseudo-Huber residual: quadratic below ``width`` (display values), linear well above."""
        error = samples.color.to(predicted.dtype) / 255 - predicted
        satisfied = (samples.color >= CLIPPED) & (error < 0)
        error = torch.where(satisfied, 0, error)
        weight = torch.rsqrt(1 + (error / width) ** 2)
        return cls(error, torch.where(satisfied, 0, weight))


def robust_cost(samples: Samples, predicted: Tensor, width: float) -> float:
    """Sum of the pseudo-Huber losses width²·(√(1 + (e/width)²) − 1) that ``Residual`` weighs."""
    error = Residual.of(samples, predicted, width).error.double()
    return float((width**2 * (torch.sqrt(1 + (error / width) ** 2) - 1)).sum())


@dataclass(frozen=True)
class NormalEquations:
    """JᵀWJ and JᵀWe of one linearisation, by the V vertices that photos tell of (``MeshPattern.vertices``).

    Attributes:
        matrix: CSR [4·V, 4·V], a vertex' channels one after the other.
        right: float32 [V, 4, 1 + G], JᵀW(e | dC by the G columns of ``Linearised.by_shared``) by channel.
        shared: float64 [G, G] and shared_right [G], those of the G columns.
        gains: of frames, eliminated from all of them; None: there are none.
    """

    matrix: Tensor
    right: Tensor
    shared: np.ndarray
    shared_right: np.ndarray
    gains: FrameBorder | None = None

    def beside(self, gains: FrameBorder) -> NormalEquations:
        """These without the ``gains``, which follow whatever the rest does."""
        taken = gains.shared()
        return replace(
            self,
            right=self.right - gains.right(self.right.shape),
            shared=self.shared - taken[1:, 1:],
            shared_right=self.shared_right - taken[1:, 0],
            gains=gains,
        )

    def __matmul__(self, values: Tensor) -> Tensor:
        """Product with vertex values [V, 4, K]."""
        product = (self.matrix @ values.reshape(len(self.matrix), -1)).reshape(values.shape)
        return product if self.gains is None else product - self.gains.product(values)

    def lumped(self) -> Tensor:
        """Row sums as one symmetric 4×4 block a vertex, [V, 4, 4]."""
        return lumped(self.matrix, CHANNELS)


Part = tuple[Tensor, Tensor]
"""Ids int64 [K], and what is to be added to the sums of each, [K, L, R]."""


def each_product(ids: Tensor, left: Tensor, right: Tensor) -> Part:
    """The products of ``left`` [N, L] and ``right`` [N, R] of samples with the ``ids`` [N]."""
    return ids, left[:, :, None] * right[:, None]


def summed_products(ids: Tensor, left: Tensor, right: Tensor) -> Part:
    """``each_product`` summed where ``ids``, which ascend, are alike; on the CPU, where that takes a quarter
    of the time of adding each."""
    if ids.device.type != "cpu":
        return each_product(ids, left, right)
    number = ids.numpy()
    first = np.r_[True, number[1:] != number[:-1]]
    count, width = left.shape
    column = width * (np.cumsum(first) - 1)[:, None] + np.arange(width)
    by_id = scipy.sparse.csr_array(
        (left.numpy().ravel(), column.ravel(), np.arange(0, count * width + 1, width)),
        shape=(count, width * int(first.sum())),
    )
    sums = (by_id.T @ right.numpy()).reshape(-1, width, right.shape[1])
    return torch.from_numpy(number[first]), torch.from_numpy(sums)


def add(sums: Tensor, part: Part) -> None:
    """Add a ``part`` to ``sums`` [T, L, R]."""
    ids, values = part
    sums.flatten(1).index_add_(0, ids, values.flatten(1))  # by rows of two axes, in a tenth of the time


@dataclass(frozen=True)
class _Products:
    """What N samples add to the normal equations.

    Attributes:
        pairs: by CORNER_PAIRS, weighted products of the slopes by the materials: of each colour with itself,
            and with roughness, and of roughness with itself, [·, 6, 7]. corners: by corner, those of the
            slopes by the materials with error and slopes by the G shared parameters, [·, 3, C·(1 + G)].
            by_gain: what ``FrameSums.add`` takes, if gains are eliminated. normal, right: of the shared
            parameters alone, float64 [G, G] and [G].
    """

    pairs: Part
    corners: Part
    by_gain: tuple[Tensor, Tensor, Tensor, Tensor] | None
    normal: np.ndarray
    right: np.ndarray

    @classmethod
    def of(
        cls,
        samples: Samples,
        ids: Tensor,
        triangles: Tensor,
        materials: Tensor,
        shared: Globals,
        width: float,
        bordered: bool,
        gains: bool,
    ) -> _Products:
        """Linearised as ``assemble`` says, which has the same arguments, of triangles with ``ids`` [N]."""
        model = linearise(samples, at_pixels(samples, triangles, materials), shared)
        residual = Residual.of(samples, model.predicted, width)
        by_roughness = model.by_roughness
        if samples.bounce is not None:
            by_roughness = torch.where(samples.sin2[:, None] < DIFFUSE_SIN2, by_roughness, 0)
        weighted_color = residual.weight * model.by_color
        weighted_roughness = residual.weight * by_roughness
        products = [weighted_color[:, c] * model.by_color[:, c] for c in range(3)]
        products += [weighted_color[:, c] * by_roughness[:, c] for c in range(3)]
        products.append((weighted_roughness * by_roughness).sum(dim=1))
        slopes = model.by_shared(shared, bordered)
        against = torch.cat([residual.error[..., None], slopes], dim=2)
        by_color = weighted_color[..., None] * against
        by_all = (weighted_roughness[..., None] * against).sum(dim=1, keepdim=True)
        by_gain = None
        if gains:
            slope = shared.gamma * model.by_globals[..., :1]
            pulled = residual.weight * slope[..., 0]
            roughness = (pulled * by_roughness).sum(dim=1, keepdim=True)
            coupled = torch.cat([pulled * model.by_color, roughness], dim=1)
            by_gain = samples.barycentric, pulled, coupled, torch.cat([slope, against], dim=2)
        slopes = slopes.flatten(0, 1)
        weighted = (slopes * residual.weight.reshape(-1, 1)).T
        return cls(
            pairs=summed_products(ids, pairs_of(samples.barycentric), torch.stack(products, dim=1)),
            corners=summed_products(
                ids, samples.barycentric, torch.cat([by_color, by_all], dim=1).flatten(1)
            ),
            by_gain=by_gain,
            normal=(weighted @ slopes).double().cpu().numpy(),
            right=(weighted @ residual.error.reshape(-1)).double().cpu().numpy(),
        )


def assemble(
    samples: Samples,
    pattern: MeshPattern,
    triangles: Tensor,
    materials: Tensor,
    shared: Globals,
    width: float,
    bordered: bool = True,
    frames: FramePattern | None = None,
) -> NormalEquations:
    """Linearise at vertex ``materials`` [V, 4] and ``shared``, and sum over the samples; unless ``bordered``
    there are no columns of what is shared, but of the scale of bounced light. Gains of the samples'
    ``frames`` are eliminated; None: they stay.

    Beside bounced light, pixels beyond DIFFUSE_SIN2 tell no roughness: it is known by patches only, and errs
    by more than the little that roughness does to Burley's diffuse lobe.
    """
    count, globals_count = len(pattern.corners), len(columns_of(shared, bordered))
    device = materials.device
    pair_sums = torch.zeros(count, len(CORNER_PAIRS), 7, device=device)
    corner_sums = torch.zeros(count, 3, CHANNELS * (1 + globals_count), device=device)
    every_id = torch.from_numpy(pattern.compact).to(device)
    sums = None if frames is None else FrameSums(frames, CHANNELS, globals_count)
    normal, right = np.zeros((globals_count,) * 2), np.zeros(globals_count)

    def one(rows: slice) -> _Products:
        more = triangles, materials, shared, width, bordered, frames is not None
        return _Products.of(samples[rows], every_id[rows], *more)

    chunks = [slice(start, start + CHUNK) for start in range(0, len(samples), CHUNK)]
    parts = (map if device.type != "cpu" else on_all_cores)(one, chunks)
    for rows, part in zip(chunks, parts, strict=True):
        add(pair_sums, part.pairs)
        add(corner_sums, part.corners)
        if sums is not None:
            sums.add(rows, *part.by_gain)
        normal += part.normal
        right += part.right
    vertex = pattern.vector(corner_sums.cpu().numpy()).astype(np.float32)
    equations = NormalEquations(
        matrix=pattern.matrix(pair_sums.cpu().numpy(), PLACES).to(device),
        right=torch.from_numpy(vertex).to(device).reshape(-1, CHANNELS, 1 + globals_count),
        shared=normal,
        shared_right=right,
    )
    return equations if sums is None else equations.beside(sums.border(device))

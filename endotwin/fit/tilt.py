"""Normals as the photos show them: shading tells tilts of a tenth of a degree, which few depth maps do.

With materials and light known, each pixel says how much its normal should tilt towards the light. Every
vertex gets the tilt on which the photos that see it agree, by a Gauss–Newton step with a Gaussian prior
about the normal that it had: photometric stereo (Woodham 1980) with a moving light and fitted albedo.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from endotwin.effects import Effects
from endotwin.fit.gauss_newton import HUBER, TEMPER, GaussNewton
from endotwin.fit.linear import conjugate_gradients
from endotwin.fit.mesh_pattern import lumped, pairs_of
from endotwin.fit.model import at_pixels, displayed, glow, radiance
from endotwin.fit.normal_equations import CHUNK, Part, Residual, add, summed_products
from endotwin.fit.state import State
from endotwin.light.guides import Incoming
from endotwin.light.incidence import COS_MIN
from endotwin.pixels.samples import Samples
from endotwin.robust import robust_std
from endotwin.run.ahead import on_all_cores
from endotwin.surface import Surface
from endotwin.surface.vectors import dot, unit

SPREAD_DEG = 0.5
"""Standard deviation of a mesh normal's error, along each axis."""

TILT_STEP = 2e-3
"""Step of the finite differences, in radians."""

STEEP_DEG, STEEP = 0.1, 5.0
"""A pixel whose channels' sum changes by so many times the noise, tilted by STEEP_DEG, is steep."""

LEAST_STEEP = 100

AXIS_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
AXIS_PLACES = tuple(tuple(AXIS_PAIRS.index((min(i, j), max(i, j))) for j in range(3)) for i in range(3))
"""Of the world's axes, and where each two stand among these pairs."""


@dataclass(frozen=True)
class Tilter:
    """Tilts normals to what the samples of ``solver`` show under the ``state``'s materials, light and
    response."""

    solver: GaussNewton
    state: State
    effects: Effects

    def tilted(self, normals: np.ndarray) -> np.ndarray:
        """The unit ``normals`` [V, 3] after one step."""
        pattern, noise = self.solver.pattern, self.solver.noise(self.state)
        scale = 1 / (noise**2 * TEMPER)
        sums, right = self._assembled(normals, noise, self._between(normals, noise))
        matrix, precision = pattern.matrix(sums * scale, AXIS_PLACES), 1 / np.radians(SPREAD_DEG) ** 2

        def product(x: Tensor) -> Tensor:
            return (matrix @ x.reshape(len(matrix), -1)).reshape(x.shape) + precision * x

        inverse = torch.linalg.inv(lumped(matrix, 3) + precision * torch.eye(3))
        right = torch.from_numpy(pattern.vector(right).astype(np.float32) * np.float32(scale))
        tilt, _ = conjugate_gradients(product, right[..., None], inverse)
        tilted = normals.copy()
        tilted[pattern.vertices] = unit(normals[pattern.vertices] + tilt[..., 0].numpy())
        return tilted

    def _between(self, normals: np.ndarray, noise: float) -> float:
        """Standard deviation in radians of a pixel's normal about that of its vertices, from pixels so steep
        that their residual is of little else; 0 where they are few.

        Sharp highlights are steep: their residuals are many times the noise, and yet say no more of a normal
        than this.
        """
        drawn = self.solver.samples[self.solver.trial_rows]
        _, slopes, residual = self._slopes(drawn, normals, np.inf)
        slope, error = slopes.sum(dim=1), residual.error.sum(dim=1)
        steep = residual.weight.all(dim=1) & (slope.abs() * np.radians(STEEP_DEG) > STEEP * noise)
        if int(steep.sum()) < LEAST_STEEP:
            return 0.0
        return robust_std((error[steep] / slope[steep]).numpy())

    def _assembled(self, normals: np.ndarray, noise: float, between: float) -> tuple[np.ndarray, np.ndarray]:
        """Sums over the samples of each triangle, by the tilt of its corners along the world's axes.

        Args:
            noise: of a pixel, in display values. between: of its normal, in radians.

        Returns:
            JᵀWJ float32 [T, 6, 6] by CORNER_PAIRS and AXIS_PAIRS; JᵀWe float32 [T, 3, 3] by corner and axis.
        """
        samples, pattern = self.solver.samples, self.solver.pattern
        sums, right = (torch.zeros(len(pattern.corners), *shape) for shape in ((6, 6), (3, 3)))
        every_id = torch.from_numpy(pattern.compact)

        def one(rows: slice) -> tuple[Part, Part]:
            part, ids = samples[rows], every_id[rows]
            axis, slope, residual = self._slopes(part, normals, HUBER * noise)
            axis = torch.from_numpy(axis)
            certain = residual.weight / (1 + (slope * (between / noise)) ** 2)
            weight = (certain * slope * slope).sum(dim=1)
            pull = (certain * slope * residual.error).sum(dim=1)
            along = torch.stack([weight * axis[:, i] * axis[:, j] for i, j in AXIS_PAIRS], dim=1)
            pairs = summed_products(ids, pairs_of(part.barycentric), along)
            return pairs, summed_products(ids, part.barycentric, pull[:, None] * axis)

        for pairs, pulls in on_all_cores(one, [slice(k, k + CHUNK) for k in range(0, len(samples), CHUNK)]):
            add(sums, pairs)
            add(right, pulls)
        return sums.numpy(), right.numpy()

    def _slopes(
        self, samples: Samples, normals: np.ndarray, width: float
    ) -> tuple[np.ndarray, Tensor, Residual]:
        """By which tilt N samples change most: its axis in the surface's frame [N, 3], and dC by its
        radians [N, 3]; and their residuals, robust beyond ``width``."""
        rotation, view, shared = samples.rotation, samples.directions, self.state.shared
        normal = at_pixels(samples, self.solver.triangles, torch.from_numpy(normals)).numpy()
        normal = unit(np.einsum("na,nab->nb", normal, rotation))
        material = at_pixels(samples, self.solver.triangles, self.state.materials)
        direct, bounced = _Direct.of(samples, view, self.effects), glow(samples, material, shared)

        def shown(tilted: np.ndarray) -> Tensor:
            return displayed(radiance(direct.seen(tilted), material, shared) + bounced, shared)

        predicted = shown(normal)
        towards = unit(-view + dot(normal, view)[:, None] * normal)
        axes = [towards] if samples.guides is None else [towards, np.cross(normal, towards)]
        slopes = [
            (shown(unit(normal + np.float32(TILT_STEP) * axis)) - predicted) / TILT_STEP for axis in axes
        ]
        axis, slope = _steepest(axes, slopes)
        return np.einsum("nb,nab->na", axis, rotation), slope, Residual.of(samples, predicted, width)


def falling_on(surface: Surface, samples: Samples, effects: Effects) -> Samples:
    """``samples`` whose guides' light falls on the ``surface``, of which normals alone are new."""
    return _Direct.of(samples, samples.directions, effects).seen(samples.normals(surface))


@dataclass(frozen=True)
class _Direct:
    """``samples`` under the light of the guides alone, seen along ``view`` [N, 3], camera frame; what of that
    no normal changes: ``incoming``, and which guides each sees."""

    samples: Samples
    view: np.ndarray
    incoming: Incoming | None
    visible: np.ndarray | None

    @classmethod
    def of(cls, samples: Samples, view: np.ndarray, effects: Effects) -> _Direct:
        guides, incoming, visible = samples.guides, None, None
        if guides is not None:
            visible = (guides.cos_i > 0).numpy()
            incoming = Incoming.at(samples.points_mm, np.asarray(effects.guides_mm), effects.profile)
        return cls(replace(samples, bounce=None), view, incoming, visible)

    def seen(self, normal: np.ndarray) -> Samples:
        """The samples with unit ``normal`` [N, 3], camera frame."""
        cos = -dot(normal, self.view)
        tangential = normal + cos[:, None] * self.view
        return replace(
            self.samples,
            cos=torch.from_numpy(np.maximum(cos, COS_MIN)),
            sin2=torch.from_numpy(dot(tangential, tangential)),
            guides=None if self.incoming is None else self.incoming.on(normal, self.visible),
        )


def _steepest(axes: list[np.ndarray], slopes: list[Tensor]) -> tuple[np.ndarray, Tensor]:
    """The direction [N, 3] in the span of ``axes`` along which the channels' sum changes most, and the slopes
    [N, 3] along it."""
    if len(axes) == 1:
        return axes[0], slopes[0]
    share = np.stack([slope.sum(dim=1).numpy() for slope in slopes], axis=1)
    share /= np.maximum(np.linalg.norm(share, axis=1, keepdims=True), np.finfo(np.float32).tiny)
    axis = sum(share[:, k, None] * direction for k, direction in enumerate(axes))
    return axis, sum(torch.from_numpy(share[:, k, None]) * slope for k, slope in enumerate(slopes))

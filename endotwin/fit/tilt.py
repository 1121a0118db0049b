"""Normals as the photos show them: shading tells tilts of a tenth of a degree, which few depth maps do.

With materials and light known, each pixel says how much its normal should tilt towards the light. Every
vertex gets the tilt on which the photos that see it agree, by a Gauss–Newton step with a Gaussian prior
about the normal that it had: photometric stereo (Woodham 1980) with a moving light and fitted albedo.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from endotwin.effects import Effects
from endotwin.fit.gauss_newton import HUBER, TEMPER, GaussNewton, State, conjugate_gradients
from endotwin.fit.model import at_pixels, predict
from endotwin.fit.normal_equations import CHUNK, MeshPattern, Residual, add_products, pairs_of
from endotwin.light.guides import guided
from endotwin.light.incidence import COS_MIN
from endotwin.pixels.samples import Samples
from endotwin.surface.vectors import dot, unit

SPREAD_DEG = 0.5
"""Standard deviation of a mesh normal's error, along each axis."""

TILT_STEP = 2e-3
"""Step of the finite differences, in radians."""

AXIS_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def tilted(normals: np.ndarray, solver: GaussNewton, state: State, effects: Effects) -> np.ndarray:
    """The unit ``normals`` [V, 3] of the vertices, tilted to what the samples of ``solver`` show."""
    samples, pattern = solver.samples, solver.pattern
    noise = solver.noise(state)
    scale = 1 / (noise**2 * TEMPER)
    sums, right = _assembled(normals, samples, pattern, solver.triangles, state, effects, HUBER * noise)
    blocks = {pair: pattern.matrix(sums[:, :, k] * scale) for k, pair in enumerate(AXIS_PAIRS)}
    blocks |= {(j, i): block for (i, j), block in blocks.items()}
    precision = 1 / np.radians(SPREAD_DEG) ** 2

    def product(x: Tensor) -> Tensor:
        rows = [sum(blocks[i, j] @ x[:, j] for j in range(3)) + precision * x[:, i] for i in range(3)]
        return torch.stack(rows, dim=1)

    ones = torch.ones(len(normals), 1)
    lumped = torch.stack([blocks[i, j] @ ones for i in range(3) for j in range(3)], 1).reshape(-1, 3, 3)
    inverse = torch.linalg.inv(lumped + precision * torch.eye(3))
    right = torch.from_numpy(pattern.vector(right).astype(np.float32) * np.float32(scale))[..., None]
    tilt = conjugate_gradients(product, right, inverse, solver.out_of_time)[..., 0].numpy()
    return unit(normals + tilt)


def _assembled(
    normals: np.ndarray,
    samples: Samples,
    pattern: MeshPattern,
    triangles: Tensor,
    state: State,
    effects: Effects,
    width: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Sums over the samples of each triangle, by the tilt of its corners along the world's axes.

    Returns:
        JᵀWJ float32 [T, 6, 6] by CORNER_PAIRS and AXIS_PAIRS; JᵀWe float32 [T, 3, 3] by corner and axis.
    """
    count = len(pattern.corners)
    sums, right = np.zeros((count, 6, 6), np.float32), np.zeros((count, 3, 3), np.float32)
    rotations = samples.views.T_local_camera[:, :3, :3].astype(np.float32)
    materials, corner_normals = state.materials, torch.from_numpy(normals)
    for start, part in zip(range(0, len(samples), CHUNK), samples.chunks(CHUNK), strict=True):
        rotation, view = rotations[part.views.row(part.frame)], part.directions
        normal = at_pixels(part, triangles, corner_normals).numpy()
        normal = unit(np.einsum("na,nab->nb", normal, rotation))
        material = at_pixels(part, triangles, materials)

        predicted = predict(_seen(part, normal, view, effects), material, state.shared)
        towards = unit(-view + dot(normal, view)[:, None] * normal)
        axes = [towards] if part.guides is None else [towards, np.cross(normal, towards)]
        slopes = []
        for axis in axes:
            seen = _seen(part, unit(normal + np.float32(TILT_STEP) * axis), view, effects)
            slopes.append((predict(seen, material, state.shared) - predicted) / TILT_STEP)
        axis, slope = _steepest(axes, slopes)
        residual = Residual.of(part, predicted, width)
        weight = (residual.weight * slope * slope).sum(dim=1).numpy()
        pull = (residual.weight * slope * residual.error).sum(dim=1).numpy()
        axis = np.einsum("nb,nab->na", axis, rotation)
        ids = pattern.compact[start : start + len(part)]
        corner = part.barycentric.numpy()
        along = np.stack([weight * axis[:, i] * axis[:, j] for i, j in AXIS_PAIRS], axis=1)
        add_products(sums, ids, pairs_of(corner), along)
        add_products(right, ids, corner, pull[:, None] * axis)
    return sums, right


def _seen(samples: Samples, normal: np.ndarray, view: np.ndarray, effects: Effects) -> Samples:
    """``samples`` with unit ``normal`` [N, 3], seen along ``view`` [N, 3], both in the camera frame."""
    cos = -dot(normal, view)
    tangential = normal + cos[:, None] * view
    guides = samples.guides
    if guides is not None:
        visible = (guides.cos_i > 0).numpy()
        guides = guided(samples.points_mm, normal, np.asarray(effects.guides_mm), effects.profile, visible)
    return replace(
        samples,
        cos=torch.from_numpy(np.maximum(cos, COS_MIN)),
        sin2=torch.from_numpy(dot(tangential, tangential)),
        guides=guides,
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

"""A closed-form start: what light and response must be if the tissue were diffuse.

Then log C = γ(log b + log L0 + n·log cosθ − q·log d + log n·ω): with one intercept a vertex (fixed effects:
subtract each vertex's mean), γn, −γq and γ are the three coefficients of a robust linear least-squares fit,
and albedo is what remains.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from endotwin import shading
from endotwin.fit.samples import Samples
from endotwin.twin import Light, Response

PRIOR = {"n": 2.0, "q": 2.0, "gamma": 1 / 2.2}
"""A bare fibre is about Lambertian with inverse-square falloff; cameras encode for a display of gamma 2.2."""

BRIGHT, DARK = 250, 5
"""Display values beyond which a photo says little about log radiance."""

HIGHLIGHT_SIN2 = 0.06
"""Nearer than asin √0.06 ≈ 14° to the mirror direction a highlight may be what is seen."""

COS_MIN = 0.1
HUBER = 1.345
ROUNDS = 6
RCOND = 1e-4
"""Singular values below this share of the largest mean that a coefficient cannot be told from the rest."""

ALBEDO_TOP = 0.8
"""The scale that light and albedo share is fixed by the 98th percentile of the brightest albedo channel."""


@dataclass(frozen=True)
class Start:
    """Light, response and the parameters that the data could not tell (kept at their prior)."""

    light: Light
    response: Response
    base_color: np.ndarray
    undetermined: tuple[str, ...]


def closed_form(samples: Samples, triangles: np.ndarray, vertex_count: int) -> Start:
    """The closed-form start from ``samples``; parameters that the data cannot tell keep their prior.

    Args:
        triangles: int [F, 3].

    Returns:
        a Start whose base_color is float32 [V, 3], with the median where no sample is.
    """
    vertex = triangles[samples.triangle.numpy(), samples.barycentric.argmax(dim=1).numpy()]
    gamma, n, q, undetermined = _coefficients(samples, vertex, vertex_count)
    light = Light(1.0, n, q)
    base_color = _albedo(samples, vertex, vertex_count, light, gamma)
    scale = np.percentile(base_color.max(axis=1), 98) / ALBEDO_TOP
    return Start(
        Light(float(scale), n, q), Response(gamma), (base_color / scale).astype(np.float32), undetermined
    )


def _coefficients(
    samples: Samples, vertex: np.ndarray, count: int
) -> tuple[float, float, float, tuple[str, ...]]:
    color = samples.color.numpy()
    use = (color.max(axis=1) < BRIGHT) & (color.min(axis=1) > DARK)
    use &= (samples.cos.numpy() > COS_MIN) & (samples.sin2.numpy() > HIGHLIGHT_SIN2)
    vertex = vertex[use]
    target = np.log(color[use].mean(axis=1, dtype=np.float64) / 255)
    columns = np.stack(
        [x.numpy()[use] for x in (samples.log_cos_axis, -samples.log_distance, samples.cos.log())], axis=1
    ).astype(np.float64)
    # Unknowns γ(n − n₀), γ(q − q₀), γ: an n or q that the data cannot tell stays at its prior n₀, q₀.
    columns[:, 2] += columns[:, :2] @ [PRIOR["n"], PRIOR["q"]]
    prior = np.array([0.0, 0.0, PRIOR["gamma"]])
    weight, coefficients, told = np.ones(len(target)), prior, np.zeros(3, bool)
    for _ in range(ROUNDS if len(target) > 3 else 0):
        centred = _without_vertex_means(columns, weight, vertex, count)
        residual = _without_vertex_means(target[:, None], weight, vertex, count)[:, 0] - centred @ prior
        change, told = _truncated_solve(
            (centred * weight[:, None]).T @ centred, centred.T @ (weight * residual)
        )
        coefficients = prior + change
        left = np.abs(residual - centred @ change)
        width = max(1.4826 * np.median(left), 1e-9)
        weight = np.minimum(1, HUBER * width / np.maximum(left, 1e-12))
    gamma = float(coefficients[2])
    if not 0.1 < gamma < 2:
        return PRIOR["gamma"], PRIOR["n"], PRIOR["q"], ("gamma", "n", "q")
    names = tuple(name for name, known in zip(("n", "q", "gamma"), told, strict=True) if not known)
    return (
        gamma,
        float(np.clip(PRIOR["n"] + coefficients[0] / gamma, 0, 10)),
        float(np.clip(PRIOR["q"] + coefficients[1] / gamma, 0, 6)),
        names,
    )


def _without_vertex_means(
    values: np.ndarray, weight: np.ndarray, vertex: np.ndarray, count: int
) -> np.ndarray:
    """Values [N, K] less the weighted mean of each vertex: the within-vertex variation."""
    total = np.maximum(np.bincount(vertex, weight, count), 1e-12)
    means = [np.bincount(vertex, weight * column, count) / total for column in values.T]
    return values - np.stack([mean[vertex] for mean in means], axis=1)


def _truncated_solve(normal: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least-squares change along the eigenvectors that the data determine, and which unknowns lie wholly in
    them.
    """
    values, vectors = np.linalg.eigh(normal)
    kept = values > RCOND * max(values[-1], 1e-12)
    change = vectors[:, kept] @ ((vectors[:, kept].T @ right) / values[kept])
    told = (vectors[:, kept] ** 2).sum(axis=1) > 0.9
    return change, told


def _albedo(samples: Samples, vertex: np.ndarray, count: int, light: Light, gamma: float) -> np.ndarray:
    """Mean albedo of each vertex [V, 3] under a diffuse model with L0 = 1; the median where there is no
    sample.
    """
    log_strength = shading.log_spotlight(
        torch.tensor(math.log(light.L0)), light.n, light.q, samples.log_cos_axis, samples.log_distance
    )
    strength = torch.exp(log_strength) * samples.cos * 2
    linear = (samples.color.float().clamp_min(1) / 255) ** (1 / gamma)
    # Least squares of linear = strength·b: a pixel counts by its light, so grazing and distant ones do not
    # add noise.
    weight = np.bincount(vertex, (strength * strength).numpy(), count)
    sums = [np.bincount(vertex, (strength * linear[:, k]).numpy(), count) for k in range(3)]
    seen = weight > 0
    albedo = np.empty((count, 3))
    for channel, values in enumerate(sums):
        albedo[seen, channel] = values[seen] / weight[seen]
    albedo[~seen] = np.median(albedo[seen], axis=0) if seen.any() else 0.5
    return albedo

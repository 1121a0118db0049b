"""A closed-form start: what light and response must be if the tissue were diffuse.

Then log C = γ(log b + log L0 + n·log cosθ − q·log d + log n·ω): with one intercept a vertex (fixed effects:
subtract each vertex's mean), γn, −γq and γ are the three coefficients of a robust linear least-squares fit,
and albedo is what remains.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from endotwin.light.forward import Lit, Lobes, shares
from endotwin.pixels.fixed_effects import HUBER, without_means
from endotwin.pixels.samples import Samples
from endotwin.robust import robust_std
from endotwin.twin import Light, Response

PRIOR = {"n": 2.0, "q": 2.0, "gamma": 1 / 2.2}
"""A bare fibre is about Lambertian with inverse-square falloff; cameras encode for a display of gamma 2.2."""

LIGHT_MEAN = (PRIOR["gamma"] * PRIOR["n"], PRIOR["gamma"] * PRIOR["q"], PRIOR["gamma"])
LIGHT_SPREAD = (0.5, 0.25, 0.1)
"""Prior of γn, γq and γ, in which a diffuse surface's log C is linear: mean and standard deviation."""

VIGNETTING_SPREAD = 0.1
"""That of γ·k2 about 0."""

BRIGHT, DARK = 250, 5
"""Display values beyond which a photo says little about log radiance."""

HIGHLIGHT_SIN2 = 0.06
"""Nearer than asin √0.06 ≈ 14° to the mirror direction a highlight may be what is seen."""

DIFFUSE_SIN2 = 0.15
"""Farther than asin √0.15 ≈ 23° from the mirror direction a rough highlight has faded, too."""

COS_MIN = 0.1
GRAZING = 0.3
"""Variance of the logarithm of light that meets a mesh at 45° by what its normals err by, over that by all
else: between 0.15 and 0.39 in half of 93 random scenes, 0.16 in photos of C3VD."""

REWEIGHTS = 6
LEAST_TOLD = 0.015
"""The photos do not tell a combination of γ(n − n₀), γ(q − q₀) and γ with a larger standard error: what the
diffuse model lacks errs by several times more, and γ is known to about 0.1 beforehand."""

RCOND = 1e-9
"""Eigenvalues below this share of the largest are rounding."""

ALBEDO_TOP = 0.8
"""The scale that light and albedo share is fixed by the 98th percentile of the brightest albedo channel."""

LAMBERT = Lobes(f0=0.0, burley=False)

ALBEDO_MIDDLE = 0.6
"""The start fixes it by the median, since the brightest of its noisy albedos are no tissue's."""


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
    vertex = samples.nearest(triangles)
    gamma, n, q, undetermined = _coefficients(samples, vertex, vertex_count)
    return _start(samples, vertex, vertex_count, n, q, gamma, undetermined)


def start_at(
    samples: Samples, triangles: np.ndarray, vertex_count: int, n: float, q: float, gamma: float
) -> Start:
    """A start from given n, q and γ, as ``closed_form`` returns it."""
    return _start(samples, samples.nearest(triangles), vertex_count, n, q, gamma, ())


def _start(
    samples: Samples,
    vertex: np.ndarray,
    vertex_count: int,
    n: float,
    q: float,
    gamma: float,
    undetermined: tuple[str, ...],
) -> Start:
    base_color = _albedo(samples, vertex, vertex_count, Light(1.0, n, q), gamma)
    scale = np.median(base_color.max(axis=1)) / ALBEDO_MIDDLE
    return Start(
        Light(float(scale), n, q),
        Response(gamma),
        (base_color / scale).astype(np.float32),
        undetermined,
    )


def trust(cos: np.ndarray) -> np.ndarray:
    """Inverse variance of the logarithm of light that meets a mesh at these cosines, 1 where it meets it
    head-on: a normal that errs by δ changes it by δ·tan θ."""
    return 1 / (1 + GRAZING * (1 / np.maximum(cos, COS_MIN) ** 2 - 1))


def diffuse(samples: Samples) -> np.ndarray:
    """Bool [N]: samples of which a diffuse model tells all: well exposed, off the highlights, not grazing."""
    darkest, brightest = (x.numpy() for x in samples.color.aminmax(dim=1))
    exposed = (brightest < BRIGHT) & (darkest > DARK)
    return exposed & (samples.cos.numpy() > COS_MIN) & (samples.sin2.numpy() > HIGHLIGHT_SIN2)


def dark(samples: Samples) -> np.ndarray:
    """Bool [N]: samples that show too little light to tell any, and that a diffuse model would tell if they
    did."""
    faint = samples.color.amin(dim=1).numpy() <= DARK
    return faint & (samples.cos.numpy() > COS_MIN) & (samples.sin2.numpy() > HIGHLIGHT_SIN2)


def _coefficients(
    samples: Samples, vertex: np.ndarray, count: int
) -> tuple[float, float, float, tuple[str, ...]]:
    color = samples.color.numpy()
    use = diffuse(samples)
    target = np.log(np.maximum(color, 1).mean(axis=1, dtype=np.float64) / 255)
    columns = [x.numpy() for x in (samples.log_cos_axis, -samples.log_distance, samples.cos.log())]
    values = np.stack([*columns, target], axis=1).astype(np.float64)[use]
    vertex, values = _sightings(vertex[use], samples.frame.numpy()[use], values)
    columns, target = values[:, :3], values[:, 3:]
    # Unknowns γ(n − n₀), γ(q − q₀), γ: an n or q that the data cannot tell stays at its prior n₀, q₀.
    columns[:, 2] += columns[:, :2] @ [PRIOR["n"], PRIOR["q"]]
    prior = np.array([0.0, 0.0, PRIOR["gamma"]])
    weight, change, told = np.ones(len(target)), np.zeros(3), np.zeros(3, bool)
    for _ in range(REWEIGHTS if len(target) > 3 else 0):
        centred = without_means(columns, weight, vertex, count)
        residual = without_means(target, weight, vertex, count)[:, 0] - centred @ prior
        left = np.abs(residual - centred @ change)
        width = robust_std(left, 1e-9)
        weight = np.minimum(1, HUBER * width / np.maximum(left, 1e-12))
        weighted = centred * weight[:, None]
        change, told = _told_change(weighted.T @ centred, weighted.T @ residual, width)
    coefficients = prior + change
    gamma = float(coefficients[2])
    if not 0.1 < gamma < 2:
        return PRIOR["gamma"], PRIOR["n"], PRIOR["q"], ("n", "q", "gamma")
    names = tuple(name for name, known in zip(("n", "q", "gamma"), told, strict=True) if not known)
    return (
        gamma,
        float(np.clip(PRIOR["n"] + coefficients[0] / gamma, 0, 10)),
        float(np.clip(PRIOR["q"] + coefficients[1] / gamma, 0, 6)),
        names,
    )


def _sightings(vertex: np.ndarray, frame: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The vertex [S] and the mean ``values`` [S, K] of each sighting: a vertex's pixels [N] in one photo.

    What varies among those is where about the vertex they lie: there, light and texture look alike.
    """
    key, which, pixels = np.unique(
        vertex.astype(np.int64) << 32 | frame, return_inverse=True, return_counts=True
    )
    means = [np.bincount(which, column, len(key)) / pixels for column in values.T]
    return key >> 32, np.stack(means, axis=1)


def _told_change(normal: np.ndarray, right: np.ndarray, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Least-squares change [3] of the unknowns that the data tell (bool [3]), the others held at 0.

    While some direction of the unknowns has a standard error above LEAST_TOLD, the one that it mostly
    consists of is held.
    """
    told = np.ones(3, bool)
    while told.any():
        values, vectors = np.linalg.eigh(normal[np.ix_(told, told)])
        if values[0] > max((noise / LEAST_TOLD) ** 2, RCOND * values[-1]):
            break
        told[np.flatnonzero(told)[np.abs(vectors[:, 0]).argmax()]] = False
    change = np.zeros(3)
    change[told] = np.linalg.solve(normal[np.ix_(told, told)], right[told])
    return change, told


def _albedo(samples: Samples, vertex: np.ndarray, count: int, light: Light, gamma: float) -> np.ndarray:
    """Mean albedo of each vertex [V, 3] under a diffuse model with L0 = 1; the median where there is no
    sample.
    """
    lit = Lit.at_lens(samples.cos, samples.sin2, samples.log_cos_axis, samples.log_distance)
    strength = shares(lit, (math.log(light.L0), light.n, light.q), samples.cos, LAMBERT)[0].per_color
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

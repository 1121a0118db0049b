"""Light, BRDF and response in float32 against 40 digits, over their whole domain and its corners.

Relative errors are of a value and its own size. A gradient is held against the size of the terms that it is
the difference of, since where it crosses zero no floating point keeps its relative error.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator

import mpmath
import numpy as np
import torch

from endotwin.light import shading
from endotwin.selfcheck.finding import Check, Finding

DIGITS = 40
F0 = shading.F0_DIELECTRIC
ROUGHNESS = (0.0, 1e-3, 0.045, 0.06, 0.1, 0.3, 0.7, 1.0)
COS = (1e-8, 1e-6, 1e-4, 1e-2, 0.1, 0.5, 0.9, 0.999, 0.999999, 1.0)
METALLIC, COLOR = (0.0, 0.5, 1.0), (0.0, 1e-3, 0.5, 1.0)
DISTANCE_MM = (1e-3, 0.1, 5.0, 40.0, 1e3)
ANGLE_DEG = (0.0, 1e-3, 30.0, 80.0, 89.0, 89.9, 89.99)
GAMMA = (0.3, 1 / 2.2, 1.0)
RADIANCE = (0.0, 1e-12, 1e-9, 1e-6, 1e-3, 0.5, 1.0, 1.0 + 1e-6, 30.0)
SPHERE_ROWS, SPHERE_COLUMNS = 400, 200


def mp_specular(cos, sin2, roughness):
    """D·G/(4 cos²) with wi = wo, as published: Walter et al. 2007, eq. 33 and 34, of α = r²."""
    alpha2 = mpmath.mpf(max(roughness, mpmath.mpf(np.float32(shading.ROUGHNESS_MIN).item()))) ** 4
    cos2_m = 1 - sin2
    D = alpha2 / (mpmath.pi * (cos2_m * (alpha2 - 1) + 1) ** 2)
    G1 = 2 / (1 + mpmath.sqrt(1 + alpha2 * (1 / cos**2 - 1)))
    return D * G1**2 / (4 * cos**2)


def mp_burley(cos, roughness):
    """Burley 2012, sec. 5.3, with wi = wo."""
    grazing = mpmath.mpf(1) / 2 + 2 * roughness
    return (1 + (grazing - 1) * (1 - cos) ** 5) ** 2


def mp_pixel(cos, sin2, roughness, color, metallic, distance, cos_axis, gamma):
    """C = (f·L·(n·ω)·2π)^γ of Han & Wu 2025 with L0 = 100, n = q = 2, and Burley's diffuse lobe."""
    lobe = (1 - metallic) * color / mpmath.pi * mp_burley(cos, roughness)
    lobe += F0 * mp_specular(cos, sin2, roughness)
    x = lobe * 100 * cos_axis**2 / distance**2 * cos * 2 * mpmath.pi
    return mp_respond(x, gamma)


def mp_respond(x, gamma):
    floor = mpmath.mpf(shading.RADIANCE_MIN)
    return (x + floor) ** gamma - floor**gamma


def pixel(cos, sin2, roughness, color, metallic, distance, cos_axis, gamma):
    """What ``mp_pixel`` says, by the functions that render and fit."""
    light = shading.log_spotlight(float(np.log(100)), 2.0, 2.0, cos_axis.log(), distance.log())
    lobe = shading.diffuse(color[:, None], metallic)[:, 0]
    lobe = lobe * shading.burley(cos, cos, torch.ones_like(cos), roughness)
    shine = F0 * shading.specular_colocated(cos, sin2, roughness)
    return shading.respond((lobe + shine) * torch.exp(light) * cos * (2 * torch.pi), gamma)


def grid(*axes) -> list[np.ndarray]:
    """Every combination of the values of ``axes``, float32 [N] each."""
    return [np.array(axis, np.float32) for axis in zip(*itertools.product(*axes), strict=True)]


def exact(function: Callable, *arguments: np.ndarray) -> np.ndarray:
    """``function`` at float32 ``arguments`` [N] each, in ``DIGITS`` digits, rounded once to float64."""
    with mpmath.workdps(DIGITS):
        rows = zip(*(map(mpmath.mpf, column.tolist()) for column in arguments), strict=True)
        return np.array([float(function(*row)) for row in rows])


def sin2_of(cos: np.ndarray) -> np.ndarray:
    """|n × ω|² of cosines float32 [N], from float64."""
    return (1 - cos.astype(np.float64) ** 2).astype(np.float32)


def relative(value: np.ndarray, reference: np.ndarray, least: float = 0.0) -> float:
    """Largest error relative to the reference, or to ``least`` where that is larger."""
    size = np.maximum(np.abs(reference), max(least, 1e-300))
    return float(np.max(np.abs(value.astype(np.float64) - reference) / size))


def values() -> Iterator[Finding]:
    """float32 values against the papers' own formulas."""
    cos, roughness = grid(COS, ROUGHNESS)
    sin2 = sin2_of(cos)
    tensors = [torch.from_numpy(x) for x in (cos, sin2, roughness)]
    highlight = shading.specular_colocated(*tensors).numpy()
    yield Finding(
        "GGX lobe, r 0–1, n·ω 1e-8–1: relative error",
        relative(highlight, exact(mp_specular, cos, sin2, roughness)),
        1e-6,
    )
    diffuse = shading.burley(tensors[0], tensors[0], torch.ones(len(cos)), tensors[2]).numpy()
    yield Finding("Burley diffuse: relative error", relative(diffuse, exact(mp_burley, cos, roughness)), 1e-6)
    angle, distance = grid(ANGLE_DEG, DISTANCE_MM)
    cos_axis = np.cos(np.radians(angle.astype(np.float64))).astype(np.float32)
    light = shading.log_spotlight(
        float(np.log(100)), 2.0, 2.0, torch.from_numpy(cos_axis).log(), torch.from_numpy(distance).log()
    )
    reference = exact(lambda c, d: 100 * c**2 / d**2, cos_axis, distance)
    error = relative(light.exp().numpy(), reference)
    yield Finding("Light, d 1e-3–1e3 mm, θ to 89.99°: relative error", error, 5e-6)
    x, gamma = grid(RADIANCE, GAMMA)
    shown = shading.respond(torch.from_numpy(x), torch.from_numpy(gamma)).numpy()
    error = relative(shown, exact(mp_respond, x, gamma), 1.0)
    yield Finding("Response, x 0–30: relative error, or in display values below 1", error, 1e-6)


def _pixels() -> list[np.ndarray]:
    """Corners of a pixel: cos, sin2, roughness, colour, metallic, distance, cosθ and γ, float32 [N] each."""
    cos, roughness, color, metallic, distance, angle, gamma = grid(
        COS[1::2], ROUGHNESS[::2], COLOR[::3], METALLIC[::2], DISTANCE_MM, ANGLE_DEG[::3], GAMMA[1:]
    )
    cos_axis = np.cos(np.radians(angle.astype(np.float64))).astype(np.float32)
    return [cos, sin2_of(cos), roughness, color, metallic, distance, cos_axis, gamma]


def pixels() -> Iterator[Finding]:
    """A pixel's colour and its gradients, whole."""
    arguments = _pixels()
    colors = pixel(*map(torch.from_numpy, arguments)).numpy()
    reference = exact(mp_pixel, *arguments)
    error = relative(colors, reference, 1e-3)
    yield Finding("Pixel colour, all corners: error relative to C, or to 1e-3", error, 1e-5)
    wrong = ~((colors >= 0) & np.isfinite(colors))
    yield Finding("Pixel colours that are negative or not finite", float(wrong.sum()), 0)
    single, double = (_gradients(arguments, dtype) for dtype in (torch.float32, torch.float64))
    yield Finding("Pixel gradients that are not finite", float((~np.isfinite(single)).sum()), 0)
    inputs = [np.maximum(np.abs(x), 1e-3) for x in arguments]
    size = np.maximum(np.abs(double), np.maximum(reference, 1e-3) / np.stack(inputs))
    error = float(np.max(np.abs(single - double) / size))
    yield Finding("Pixel gradients, all inputs: error relative to C/input", error, 1e-4)


def _gradients(arguments: list[np.ndarray], dtype: torch.dtype) -> np.ndarray:
    """Slopes [8, N] of the pixel's colour by its inputs, automatic, computed in ``dtype``."""
    inputs = [torch.from_numpy(x).to(dtype).requires_grad_() for x in arguments]
    return np.stack([slope.double().numpy() for slope in torch.autograd.grad(pixel(*inputs).sum(), inputs)])


def gradients() -> Iterator[Finding]:
    """Automatic gradients in float64 against the derivative of the published formula in 40 digits."""
    cos, roughness = grid(COS[2:], ROUGHNESS[3:])
    sin2 = sin2_of(cos)
    inputs = [torch.from_numpy(x).double().requires_grad_() for x in (cos, sin2, roughness)]
    automatic = torch.autograd.grad(shading.specular_colocated(*inputs).sum(), inputs)
    for name, slope, which in zip(("n·ω", "sin²", "roughness"), automatic, range(3), strict=True):
        order = tuple(int(k == which) for k in range(3))
        reference = exact(lambda *at, order=order: mpmath.diff(mp_specular, at, order), cos, sin2, roughness)
        size = exact(mp_specular, cos, sin2, roughness) / np.maximum([cos, sin2, roughness][which], 1e-3)
        error = float(np.max(np.abs(slope.numpy() - reference) / np.maximum(np.abs(reference), size)))
        yield Finding(f"GGX slope by {name} against 40 digits", error, 1e-9)


def responses() -> Iterator[Finding]:
    """The response at and near 0 and at 1."""
    x = torch.tensor([0.0, 1e-9, 1e-6, 1.0, 1.0 + 1e-6], requires_grad=True)
    shown = shading.respond(x, 1 / 2.2)
    slope = torch.autograd.grad(shown.sum(), x)[0].double().numpy()
    shown = shown.detach()
    yield Finding("Response at 0", abs(float(shown[0])), 0)
    at = x.detach().numpy()
    reference = exact(lambda v: mpmath.diff(lambda t: mp_respond(t, 1 / mpmath.mpf("2.2")), v), at)
    yield Finding("Response slope at 0, 1e-9, 1e-6, 1: relative error", relative(slope, reference), 1e-5)
    yield Finding("Response at 1 is 1, less the offset at 0", abs(float(shown[3]) - 1), 0.5 / 255)


def _hemisphere() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions [N, 3] evenly over the hemisphere's cosine and azimuth."""
    cos = ((np.arange(SPHERE_ROWS) + 0.5) / SPHERE_ROWS)[:, None]
    azimuth = ((np.arange(SPHERE_COLUMNS) + 0.5) * 2 * np.pi / SPHERE_COLUMNS)[None]
    sin = np.sqrt(1 - cos**2)
    return sin * np.cos(azimuth), sin * np.sin(azimuth), cos + 0 * azimuth


def _reflected(cos_o: float, roughness: float, f0: float) -> tuple[float, float]:
    """Shares of the light from all directions that the white diffuse and the specular lobe send along wo."""
    x, y, cos_i = _hemisphere()
    sin_o = (1 - cos_o**2) ** 0.5
    length = np.sqrt((x + sin_o) ** 2 + y**2 + (cos_i + cos_o) ** 2)
    cos_d = ((x + sin_o) * x + y * y + (cos_i + cos_o) * cos_i) / length
    sin2_m = ((x + sin_o) ** 2 + y**2) / length**2
    tensors = [torch.from_numpy(np.broadcast_to(v, x.shape).copy()) for v in (cos_i, cos_o, sin2_m, cos_d)]
    rough = torch.full(x.shape, roughness, dtype=torch.float64)
    shine = shading.specular(*tensors, rough, torch.tensor(f0, dtype=torch.float64)).numpy()
    scatter = shading.burley(tensors[0], tensors[1], tensors[3], rough).numpy() / np.pi
    return float((scatter * cos_i).mean() * 2 * np.pi), float((shine * cos_i).mean() * 2 * np.pi)


def energy() -> Iterator[Finding]:
    """White furnaces. The paper's 2π in C = (f·L·(n·ω)·2π)^γ scales L0 alike for all pixels: no energy."""
    corners = list(itertools.product((1e-3, 0.05, 0.3, 1.0), (0.2, 0.5, 1.0)))
    shares = np.array([_reflected(cos_o, roughness, 1.0) for cos_o, roughness in corners])
    both = np.array([_reflected(cos_o, roughness, F0) for cos_o, roughness in corners]).sum(axis=1)
    yield Finding("GGX lobe with f0 = 1 reflects at most what it receives", float(shares[:, 1].max()), 1.001)
    yield Finding("Lambert lobe with b = 1 reflects what it receives: error", abs(_lambert() - 1), 1e-6)
    head_on = np.array([cos_o == 1 for cos_o, _ in corners])
    yield Finding("Burley and GGX with b = 1, f0 = 0.04, seen head on", float(both[head_on].max()), 1.1)
    yield Finding("the same at any angle (Disney's diffuse gains energy where rough)", float(both.max()), 2)


def _lambert() -> float:
    _, _, cos_i = _hemisphere()
    lobe = shading.diffuse(torch.ones(1, 1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64))
    return float(lobe) * float(cos_i.mean()) * 2 * np.pi


def reciprocity() -> Iterator[Finding]:
    """f(wi, wo) = f(wo, wi), and no lobe is negative."""
    pair = np.random.default_rng(0).normal(size=(2, 4000, 3))
    pair[..., 2] = np.abs(pair[..., 2])
    wi, wo = pair / np.linalg.norm(pair, axis=-1, keepdims=True)
    wm = (wi + wo) / np.linalg.norm(wi + wo, axis=-1, keepdims=True)
    cos_i, cos_o, sin2, cos_d = (
        torch.from_numpy(v.astype(np.float32))
        for v in (wi[:, 2], wo[:, 2], 1 - wm[:, 2] ** 2, (wi * wm).sum(axis=1))
    )
    rough = torch.from_numpy(np.random.default_rng(1).random(4000, np.float32))
    f0 = torch.tensor(F0)

    def lobes(one: torch.Tensor, other: torch.Tensor) -> list[torch.Tensor]:
        return [
            shading.specular(one, other, sin2, cos_d, rough, f0),
            shading.burley(one, other, cos_d, rough),
        ]

    pairs = list(zip(lobes(cos_i, cos_o), lobes(cos_o, cos_i), strict=True))
    worst = max(relative(one.numpy(), other.double().numpy()) for one, other in pairs)
    yield Finding("Reciprocity of both lobes: relative error", worst, 1e-6)
    yield Finding("Least value of any lobe", min(float(one.min()) for one, _ in pairs), 0, at_least=True)


CHECKS: tuple[Check, ...] = (values, pixels, gradients, responses, energy, reciprocity)

"""Shading against the papers' own formulas, uncancelled, in float64; and what any BRDF must obey."""

import itertools
import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad

from endotwin.light import shading

ROUGHNESS = (0.05, 0.1, 0.25, 0.5, 0.8, 1.0)
COS = (1.0, 0.999, 0.9, 0.6, 0.3, 0.1, 0.01)


def grid(*axes) -> tuple[np.ndarray, ...]:
    return tuple(np.array(axis) for axis in zip(*itertools.product(*axes), strict=True))


def t64(values) -> torch.Tensor:
    return torch.as_tensor(np.asarray(values), dtype=torch.float64)


def ggx(cos_m: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Walter et al. 2007, eq. 33: α² / (π cos⁴θ (α² + tan²θ)²)."""
    tan2 = 1 / cos_m**2 - 1
    return alpha**2 / (np.pi * cos_m**4 * (alpha**2 + tan2) ** 2)


def smith_g1(cos: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Walter et al. 2007, eq. 34."""
    return 2 / (1 + np.sqrt(1 + alpha**2 * (1 / cos**2 - 1)))


def directions(polar: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    return np.stack(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar) + 0 * azimuth], -1
    )


def lobe(
    wi: np.ndarray, wo: np.ndarray, roughness: float, f0: float, specular=shading.specular
) -> np.ndarray:
    """``specular`` [N] of directions [N, 3] about the normal z."""
    wm = (wi + wo) / np.linalg.norm(wi + wo, axis=-1, keepdims=True)
    values = wi[..., 2], wo[..., 2], 1 - wm[..., 2] ** 2, (wi * wm).sum(-1)
    return specular(*map(t64, values), t64(roughness), t64(f0)).numpy()


def random_pairs(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Two directions [N, 3] each in the upper hemisphere."""
    pair = np.random.default_rng(0).normal(size=(2, count, 3))
    pair /= np.linalg.norm(pair, axis=-1, keepdims=True)
    pair[..., 2] = np.abs(pair[..., 2])
    return pair[0], pair[1]


@pytest.mark.parametrize("roughness", ROUGHNESS)
def test_a_tail_of_2_is_ggx_and_one_of_1_is_burleys_clearcoat(roughness):
    """Burley 2012, appendix B.2: (α² − 1) / (π·ln α²·(1 + (α² − 1)·cos²))."""
    cos2, alpha = np.linspace(0, 1, 50), t64(roughness**2)
    close = {"rtol": 1e-5, "atol": 0}
    torch.testing.assert_close(
        shading.gtr(t64(1 - cos2), alpha, 2.0), shading.ggx(t64(1 - cos2), alpha), **close
    )
    if roughness < 1:
        alpha2 = roughness**4
        expected = (alpha2 - 1) / (math.pi * math.log(alpha2) * (1 + (alpha2 - 1) * cos2))
        torch.testing.assert_close(shading.gtr(t64(1 - cos2), alpha, 1.0), t64(expected), **close)


def test_ggx_is_walters_distribution():
    cos_m, roughness = grid(COS, ROUGHNESS)
    expected = ggx(cos_m, roughness**2)
    np.testing.assert_allclose(shading.ggx(t64(1 - cos_m**2), t64(roughness**2)), expected, rtol=1e-10)


def test_smith_visibility_is_g_over_4_cos_cos():
    cos_i, cos_o, roughness = grid(COS, COS, ROUGHNESS)
    alpha = roughness**2
    expected = smith_g1(cos_i, alpha) * smith_g1(cos_o, alpha) / (4 * cos_i * cos_o)
    np.testing.assert_allclose(
        shading.smith_visibility(t64(cos_i), t64(cos_o), t64(alpha)), expected, rtol=1e-10
    )


def test_specular_lobe_is_the_microfacet_model_for_any_pair_of_directions():
    wi, wo = random_pairs(500)
    wm = (wi + wo) / np.linalg.norm(wi + wo, axis=-1, keepdims=True)
    for roughness, f0 in itertools.product(ROUGHNESS, (0.04, 1.0)):
        fresnel = f0 + (1 - f0) * (1 - (wi * wm).sum(-1)) ** 5
        g = smith_g1(wi[:, 2], roughness**2) * smith_g1(wo[:, 2], roughness**2)
        expected = ggx(wm[:, 2], roughness**2) * fresnel * g / (4 * wi[:, 2] * wo[:, 2])
        np.testing.assert_allclose(lobe(wi, wo, roughness, f0), expected, rtol=1e-7)


def test_colocated_lobe_times_f0_is_the_lobe_with_both_directions_alike():
    cos, roughness = grid(COS, ROUGHNESS)
    apart = shading.specular(
        t64(cos), t64(cos), t64(1 - cos**2), t64(np.ones_like(cos)), t64(roughness), t64(0.04)
    )
    together = 0.04 * shading.specular_colocated(t64(cos), t64(1 - cos**2), t64(roughness))
    np.testing.assert_allclose(together, apart, rtol=1e-12)


def test_float32_keeps_the_highlight_to_a_ten_thousandth():
    sin2, roughness = grid(np.r_[0, np.logspace(-10, -0.01, 60)], (0.045, *ROUGHNESS))
    cos = np.sqrt(1 - sin2)
    exact = shading.specular_colocated(t64(cos), t64(sin2), t64(roughness)).numpy()
    single = shading.specular_colocated(
        *(torch.tensor(x, dtype=torch.float32) for x in (cos, sin2, roughness))
    )
    np.testing.assert_allclose(single.numpy(), exact, rtol=1e-4)


def test_burley_diffuse_is_disneys_published_formula():
    """Burley 2012, sec. 5.3: (1 + (FD90 − 1)(1 − cosθl)⁵)(1 + (FD90 − 1)(1 − cosθv)⁵), FD90 = ½ + 2r·cos²θd.

    Burley 2015 writes it as a Fresnel-dimmed diffuse and a retro-reflective part, whose sum is the same.
    """
    cos_i, cos_o, cos_d, roughness = grid(COS, COS, (1.0, 0.7, 0.2), ROUGHNESS)
    at_grazing = 0.5 + 2 * roughness * cos_d**2
    expected = (1 + (at_grazing - 1) * (1 - cos_i) ** 5) * (1 + (at_grazing - 1) * (1 - cos_o) ** 5)
    got = shading.burley(t64(cos_i), t64(cos_o), t64(cos_d), t64(roughness))
    np.testing.assert_allclose(got, expected, rtol=1e-12)


def test_lobes_are_reciprocal():
    wi, wo = random_pairs(300)
    for roughness in ROUGHNESS:
        np.testing.assert_allclose(lobe(wi, wo, roughness, 0.04), lobe(wo, wi, roughness, 0.04), rtol=1e-12)
        cos_i, cos_o, cos_d = t64(wi[:, 2]), t64(wo[:, 2]), t64(np.full(300, 0.7))
        np.testing.assert_allclose(
            shading.burley(cos_i, cos_o, cos_d, t64(roughness)),
            shading.burley(cos_o, cos_i, cos_d, t64(roughness)),
            rtol=1e-13,
        )


@pytest.mark.parametrize("roughness", ROUGHNESS)
@pytest.mark.parametrize("tail", (1.0, 1.0001, 1.5, 2.0))
def test_microfacets_cover_the_surface_exactly_once_whatever_their_tail(roughness, tail):
    """∫ D(wm)·(n·wm) dwm = 1 over the hemisphere."""

    def integrand(log_tan: float) -> float:
        tan2 = math.exp(2 * log_tan)
        cos2 = 1 / (1 + tan2)
        density = float(shading.gtr(t64(tan2 * cos2), t64(roughness**2), tail))
        return 2 * math.pi * density * cos2 * tan2 * cos2

    assert quad(integrand, -16, 12, limit=400)[0] == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("roughness", (0.2, 0.5, 0.8, 1.0))
@pytest.mark.parametrize("cos_o", (0.98, 0.6, 0.2))
def test_specular_lobe_reflects_no_more_than_it_receives_even_as_a_white_furnace(roughness, cos_o):
    """With f0 = 1 the lobe loses only what Smith's G hides: nothing when smooth, some when rough."""
    rows, columns = 1600, 800
    cos_i = (np.arange(rows) + 0.5) / rows
    azimuth = (np.arange(columns) + 0.5) * 2 * np.pi / columns
    wi = directions(np.arccos(cos_i)[:, None], azimuth[None])
    wo = directions(np.arccos(cos_o), np.zeros(()))
    furnace = (lobe(wi, wo, roughness, 1.0) * wi[..., 2]).mean() * 2 * np.pi
    assert furnace <= 1.001
    assert furnace > (0.97 if roughness == 0.2 and cos_o > 0.5 else 0.3)
    assert (lobe(wi, wo, roughness, 0.04) * wi[..., 2]).mean() * 2 * np.pi < furnace


def test_lambert_lobe_reflects_its_base_color():
    base_color = t64([[0.8, 0.4, 0.1]])
    reflected = shading.diffuse(base_color, t64([0.25])) * math.pi
    np.testing.assert_allclose(reflected, 0.75 * base_color, rtol=1e-12)


def test_light_is_a_cosine_power_with_a_distance_power():
    cos_axis, distance = grid((1.0, 0.8, 0.05), (2.0, 17.0, 90.0))
    got = shading.log_spotlight(math.log(37.0), 1.7, 2.2, t64(np.log(cos_axis)), t64(np.log(distance)))
    np.testing.assert_allclose(got.exp(), 37.0 * cos_axis**1.7 / distance**2.2, rtol=1e-12)


def test_gradients_equal_central_differences():
    """autograd's own check of every input of every formula, in float64."""
    generator = torch.Generator().manual_seed(0)

    def inputs(low: float = 0.1, high: float = 0.95, count: int = 7) -> torch.Tensor:
        values = torch.rand(count, generator=generator, dtype=torch.float64)
        return (low + (high - low) * values).requires_grad_()

    for function, arguments in (
        (shading.burley, [inputs() for _ in range(4)]),
        (shading.ggx, [inputs() for _ in range(2)]),
        (shading.smith_visibility, [inputs() for _ in range(3)]),
        (shading.specular, [inputs() for _ in range(6)]),
        (shading.specular_colocated, [inputs() for _ in range(3)]),
        (shading.respond, [inputs(1e-3, 2.0), inputs(0.3, 0.6)]),
        (shading.log_spotlight, [inputs() for _ in range(5)]),
    ):
        assert torch.autograd.gradcheck(function, arguments), function.__name__


@pytest.mark.parametrize("dtype", (torch.float32, torch.float64))
def test_every_value_and_gradient_is_finite_in_the_corners(dtype):
    cos, sin2, roughness = (
        torch.tensor(axis, dtype=dtype).requires_grad_()
        for axis in grid((1e-8, 1e-4, 0.5, 1.0), (0.0, 1e-12, 1.0), (0.0, 1e-6, 0.045, 1.0))
    )
    one = torch.ones_like(cos)
    values = [
        shading.specular_colocated(cos, sin2, roughness),
        shading.specular(cos, cos, sin2, one, roughness, torch.tensor(0.04, dtype=dtype)),
        shading.burley(cos, cos, one, roughness),
    ]
    for value in values:
        assert torch.isfinite(value).all()
        for gradient in torch.autograd.grad(value.sum(), [cos, sin2, roughness], allow_unused=True):
            assert gradient is None or torch.isfinite(gradient).all()


def test_response_is_a_power_that_starts_at_zero_with_a_finite_slope():
    x = torch.tensor([0.0, 1e-9, 1e-3, 0.1, 1.0, 3.0], dtype=torch.float64, requires_grad=True)
    for gamma in (1 / 2.2, 0.3, 1.0):
        shown = shading.respond(x, gamma)
        assert shown[0] == 0
        assert (shown[1:] > shown[:-1]).all()
        slope = torch.autograd.grad(shown.sum(), x)[0]
        assert torch.isfinite(slope).all() and (slope > 0).all()
        back = shading.radiance_of(shown.detach().numpy(), gamma)
        np.testing.assert_allclose(back, x.detach().numpy(), rtol=1e-9, atol=1e-15)
    half_a_step = 0.5 / 255
    np.testing.assert_allclose(
        shading.respond(x, 1 / 2.2).detach()[2:], x.detach().numpy()[2:] ** (1 / 2.2), atol=1.01 * half_a_step
    )
    assert shading.respond(torch.tensor(1.0), 1 / 2.2) == pytest.approx(1, abs=1.01 * half_a_step)

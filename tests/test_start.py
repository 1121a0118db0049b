"""The closed-form start finds light and response of a diffuse surface, and says what it cannot tell."""

import numpy as np
import pytest
import torch

from endotwin.pixels.samples import Samples
from endotwin.pixels.start import ALBEDO_MIDDLE, PRIOR, closed_form

VERTICES = 400
GAMMA, CONE, FALLOFF = 0.40, 1.6, 2.25
"""Far enough from the prior that keeping it would show."""


def diffuse_samples(
    count: int, noise: float, outliers: float = 0.0, **fixed: float
) -> tuple[Samples, np.ndarray]:
    """Photos of Lambertian vertices, 8 bit, ``fixed`` values of cos, cos_axis or distance; and the albedo.

    A share ``outliers`` of the samples is brightened by half, as by a highlight that the diffuse model lacks.
    """
    generator = np.random.default_rng(0)

    def drawn(name: str, low: float, high: float) -> np.ndarray:
        return np.full(count, fixed[name]) if name in fixed else generator.uniform(low, high, count)

    cos, cos_axis, distance = drawn("cos", 0.25, 0.95), drawn("cos_axis", 0.55, 1), drawn("distance", 12, 40)
    albedo = generator.uniform(0.2, 0.8, (VERTICES, 3))
    vertex = np.sort(generator.integers(0, VERTICES, count))
    strength = 300 * cos_axis**CONE / distance**FALLOFF * cos * 2
    shown = np.clip(albedo[vertex] * strength[:, None], 0, 1) ** GAMMA
    shown[generator.random(count) < outliers] *= 1.5
    shown = np.clip(shown + generator.normal(0, noise, shown.shape), 0, 1)
    return Samples(
        triangle=torch.from_numpy(vertex),
        barycentric=torch.tensor([[0.8, 0.1, 0.1]]).repeat(count, 1),
        cos=torch.from_numpy(cos).float(),
        sin2=torch.from_numpy(1 - cos**2).float(),
        log_cos_axis=torch.from_numpy(np.log(cos_axis)).float(),
        log_distance=torch.from_numpy(np.log(distance)).float(),
        color=torch.from_numpy(np.uint8(shown * 255 + 0.5)),
        frame=torch.arange(count, dtype=torch.int32),
        pixel=torch.zeros(count, dtype=torch.int32),
    ), albedo


def fan() -> np.ndarray:
    """Triangle v begins with vertex v, so that a sample of it belongs to that vertex."""
    vertex = np.arange(VERTICES)
    return np.stack([vertex, (vertex + 1) % VERTICES, (vertex + 2) % VERTICES], axis=1)


@pytest.mark.parametrize(
    "noise, outliers, within", [(0, 0, 0.005), (1 / 255, 0, 0.015), (1 / 255, 0.05, 0.03)]
)
def test_light_and_response_of_a_diffuse_surface_are_recovered(noise, outliers, within):
    samples, albedo = diffuse_samples(40_000, noise, outliers)
    start = closed_form(samples, fan(), VERTICES)
    assert start.undetermined == ()
    assert start.response.gamma == pytest.approx(GAMMA, rel=within)
    assert start.light.n == pytest.approx(CONE, rel=2 * within)
    assert start.light.q == pytest.approx(FALLOFF, rel=within)
    ratio = start.base_color / albedo
    assert np.std(ratio) / np.mean(ratio) < (0.1 if outliers else 0.05)


def test_light_and_albedo_share_the_scale_that_reproduces_the_photos():
    samples, albedo = diffuse_samples(40_000, 0)
    start = closed_form(samples, fan(), VERTICES)
    far = 22.0
    truth = np.median(albedo) * 300 / far**FALLOFF
    got = np.median(start.base_color) * start.light.L0 / far**start.light.q
    assert got == pytest.approx(truth, rel=0.05)
    assert np.median(start.base_color.max(axis=1)) == pytest.approx(ALBEDO_MIDDLE, rel=1e-4)


def test_one_distance_and_one_axis_angle_leave_cone_and_falloff_at_the_prior_and_say_so():
    samples, _ = diffuse_samples(20_000, 1 / 255, distance=20.0, cos_axis=0.9)
    start = closed_form(samples, fan(), VERTICES)
    assert set(start.undetermined) == {"n", "q"}
    assert (start.light.n, start.light.q) == pytest.approx((PRIOR["n"], PRIOR["q"]))
    assert start.response.gamma == pytest.approx(GAMMA, rel=0.02)
    assert np.isfinite(start.base_color).all() and np.isfinite(start.light.L0)


def test_a_camera_that_never_moves_tells_nothing():
    samples, _ = diffuse_samples(5_000, 1 / 255, distance=20.0, cos_axis=0.9, cos=0.6)
    start = closed_form(samples, fan(), VERTICES)
    assert set(start.undetermined) == {"gamma", "n", "q"}
    assert (start.response.gamma, start.light.n, start.light.q) == pytest.approx(
        (PRIOR["gamma"], PRIOR["n"], PRIOR["q"])
    )
    assert np.isfinite(start.base_color).all()


def test_vertices_without_a_sample_take_the_median_albedo():
    samples, _ = diffuse_samples(20_000, 0)
    start = closed_form(samples[samples.triangle < 300], fan(), VERTICES)
    np.testing.assert_allclose(
        start.base_color[300:], np.tile(np.median(start.base_color[:300], axis=0), (100, 1)), rtol=1e-5
    )


@pytest.mark.parametrize("level", (0, 255))
def test_black_or_clipped_photos_give_the_prior_and_finite_albedo(level):
    samples, _ = diffuse_samples(2_000, 0)
    samples.color[:] = level
    start = closed_form(samples, fan(), VERTICES)
    assert start.response.gamma == pytest.approx(PRIOR["gamma"])
    assert start.undetermined and np.isfinite(start.base_color).all() and start.light.L0 > 0

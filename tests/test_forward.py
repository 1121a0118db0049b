"""The forward model: its special case, its limits, and the derivatives that least squares takes of it."""

from dataclasses import replace

import numpy as np
import pytest
import test_model
import torch
from independent.gloss import Gloss

from endotwin.effects.coat import Coat
from endotwin.effects.tone import Tone, bend
from endotwin.fit.model import linearise
from endotwin.light import forward, shading
from endotwin.light.forward import Lit, Lobes
from endotwin.light.guides import AT_LENS, COSINE, guided
from endotwin.surface.vectors import dot, unit

LOG_LIGHT = (4.0, 1.7, 2.1)


def test_light_at_the_lens_is_one_guide_at_the_origin():
    generator = np.random.default_rng(0)
    points_mm = generator.uniform((-8, -8, 10), (8, 8, 30), (500, 3))
    normals = unit(unit(-points_mm) + 0.5 * generator.normal(size=(500, 3)))
    normals *= np.sign(-dot(normals, points_mm))[:, None]
    wo = unit(-points_mm)
    across = np.cross(normals, wo)
    distance_mm = np.linalg.norm(points_mm, axis=1)
    cos, sin2 = dot(normals, wo), dot(across, across)
    columns = (cos, sin2, np.log(-wo[:, 2]), np.log(distance_mm))
    at_lens = Lit.at_lens(*map(torch.from_numpy, columns))
    beside = Lit(torch.from_numpy(cos), guided(points_mm, normals, np.array(AT_LENS), COSINE))
    material = test_model.made_materials(500)
    lobes = Lobes(0.04, coat=(0.7, 0.2, 2.0))
    both = [
        forward.radiance(lit, LOG_LIGHT, material[:, :3], material[:, 3], lobes) for lit in (at_lens, beside)
    ]
    torch.testing.assert_close(*both, rtol=1e-5, atol=1e-9)


def test_equal_guides_in_one_place_are_one_guide():
    samples, material = test_model.made_samples(100, 17), test_model.made_materials(100)
    one = samples.lit(*LOG_LIGHT[1:])
    three = replace(one, guides=replace_all(one.guides, lambda value: value.expand(-1, 3)))
    arguments = LOG_LIGHT, material[:, :3], material[:, 3], Lobes(0.04)
    torch.testing.assert_close(forward.radiance(one, *arguments), forward.radiance(three, *arguments))


def replace_all(guides, change):
    return replace(guides, **{name: change(value) for name, value in vars(guides).items()})


def test_exposure_scales_all_light():
    samples, material = test_model.in_a_tube(test_model.made_samples(100, 17)), test_model.made_materials(100)
    dark = samples.lit(*LOG_LIGHT[1:])
    bright = replace(dark, log_exposure=torch.full((100,), 0.3, dtype=torch.float64))
    arguments = LOG_LIGHT, material[:, :3], material[:, 3], Lobes(0.04, coat=(0.7, 0.2, 2.0))
    ratio = forward.radiance(bright, *arguments) / forward.radiance(dark, *arguments)
    torch.testing.assert_close(ratio, torch.full_like(ratio, float(np.exp(0.3))))


@pytest.mark.parametrize("scene", test_model.SCENES)
@pytest.mark.parametrize("coat", [None, Coat(0.6, 0.2), Coat(0.6, 0.2, tail=1.0)])
@pytest.mark.parametrize("tone", [None, Tone(0.4)])
def test_the_derivatives_of_least_squares_are_those_of_automatic_differentiation(scene, coat, tone):
    """By base colour, roughness, coat and, at the displayed colour b^γ, by what all pixels share."""
    samples = test_model.SCENES[scene](test_model.made_samples(40, 17))
    material, shared = test_model.made_materials(40), replace(test_model.shared_of(scene), coat=coat)
    shared = shared.under(tone)
    model = linearise(samples, material, shared)
    shown = material[:, :3] ** shared.gamma

    def predicted(vector, roughness, weight):
        log_L0, n, q = vector[:3] / vector[3]
        scale = vector[-1] if shared.bounces else 0.0
        lobes = Lobes(
            torch.exp(vector[4]), coat=None if coat is None else (weight, coat.roughness, coat.tail)
        )
        color = shown ** (1 / vector[3])
        lit = samples.lit(n, q, scale, vector[3], lobes.f0)
        if shared.vignettes:
            exposed = 0.0 if lit.log_exposure is None else lit.log_exposure
            lit = replace(lit, log_exposure=exposed + vector[5] / vector[3] * samples.radius2)
        if samples.bounce is not None and samples.bounce.shown is not None:
            followed = samples.bounce.followed(torch.log(color), vector[3])
            lit = replace(lit, irradiance=lit.irradiance * followed)
        x = forward.radiance(lit, (log_L0, n, q), color, roughness, lobes)
        untoned = shading.respond(x, vector[3])
        return untoned if tone is None else untoned + vector[shared.unscaled - 1] * bend(untoned)

    weight = torch.tensor(0.0 if coat is None else coat.weight, dtype=torch.float64)
    by_vector, by_roughness, by_weight = torch.autograd.functional.jacobian(
        predicted, (shared.vector, material[:, 3].clone(), weight)
    )
    close = {"rtol": 1e-8, "atol": 1e-10}
    torch.testing.assert_close(model.by_globals, by_vector, **close)
    torch.testing.assert_close(model.by_roughness, by_roughness.diagonal(dim1=0, dim2=2).T, **close)
    if coat is not None:
        torch.testing.assert_close(model.by_coat, by_weight, **close)


@pytest.mark.parametrize("coat", [None, (0.6, 0.2, 2.0), (3.0, 0.3, 1.0)])
def test_gloss_is_linear_in_f0(coat):
    generator = torch.Generator().manual_seed(3)
    cos, roughness = torch.rand(2, 50, generator=generator, dtype=torch.float64)
    dull, bright = Lobes(0.01, coat=coat), Lobes(0.08, coat=coat)
    more = bright.gloss(cos, roughness) - dull.gloss(cos, roughness)
    torch.testing.assert_close(more[:, 0], 0.07 * dull.gloss_by_f0(cos, roughness))
    assert not more[:, 1].any()
    more = bright.glossy_albedo(roughness) - dull.glossy_albedo(roughness)
    torch.testing.assert_close(more, bright.f0_albedo(roughness) - dull.f0_albedo(roughness))
    torch.testing.assert_close(dull.f0_albedo(roughness), more / 7)


@pytest.mark.parametrize("weight", [0.4, 1.0, 3.0, 50.0])
def test_a_coat_mirrors_light_from_all_around_as_a_layer_of_its_reflectance_and_never_all_of_it(weight):
    """One that covers half of the tissue mirrors half at any angle; one brighter than water is denser, and
    mirrors all of what grazes it, not as many times all."""
    cos, roughness = torch.linspace(0.02, 1, 50, dtype=torch.float64), 0.3
    share = Lobes(0.0, coat=(weight, roughness, 2.0)).gloss(cos, torch.full_like(cos, 0.4))[:, 0].numpy()
    layer = Gloss(max(1.0, weight) * shading.F0_WATER).at(cos.numpy(), np.full(len(cos), roughness))
    np.testing.assert_allclose(share, min(1.0, weight) * layer, atol=0.02)
    assert share.max() <= 1

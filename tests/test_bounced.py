"""Bounced light at points, against what an integrating sphere makes of it."""

import numpy as np
import pytest
import torch
import trimesh
from independent.gloss import Gloss

from endotwin.fusion.mesh import surface_of
from endotwin.light.bounced import BOUNCES_BY, GAMMA_STEP, Albedo, BouncedLight, Places
from endotwin.light.forward import Lobes
from endotwin.light.guides import AT_LENS, COSINE
from endotwin.light.radiosity import Radiosity
from endotwin.light.shading import F0_DIELECTRIC, ROUGHNESS_TISSUE
from endotwin.surface.casting import Caster

RADIUS_MM = 10.0
BASE_COLOR, ROUGHNESS = 0.5, 0.4
WET = Lobes(0.04, coat=(0.8, 0.12, 2.0))
HEAD_ON = float(
    Gloss(F0_DIELECTRIC).at(np.ones(1), np.array([ROUGHNESS_TISSUE]))[0]
    / Lobes(F0_DIELECTRIC).glossy_albedo(torch.tensor(ROUGHNESS_TISSUE))
)
"""Of head-on light tissue's lobe reflects so much of what it does of light from all around."""

GLOSSY = float(WET.glossy_albedo(torch.tensor(ROUGHNESS)))


@pytest.fixture(scope="module")
def sphere() -> tuple[BouncedLight, Places, Albedo]:
    """Light at the centre of a hollow sphere in two views, seen at its vertices in turns."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS_MM)
    surface = surface_of(np.zeros(3), np.asarray(ball.vertices, np.float32), ball.faces[:, ::-1])
    radiosity = Radiosity(surface, Caster(surface), cell_mm=3.0)
    count = len(surface.vertices_mm)
    color, roughness = torch.full((count, 3), BASE_COLOR), torch.full((count,), ROUGHNESS)
    albedo = Albedo.of(radiosity, color, roughness, WET, surface.triangles)
    light = BouncedLight(radiosity, np.tile(np.eye(4), (2, 1, 1)), AT_LENS, COSINE)
    return light, Places(radiosity.to_vertex, np.arange(count) % 2), albedo


def series(albedo: float) -> float:
    """E/E_direct = (ρ + ρ² + …)/2 of a light that faces half the sphere (Ulbricht's integrating sphere)."""
    return albedo / (1 - albedo) / 2


@pytest.mark.parametrize("log_scale", [0.0, 0.3])
def test_what_is_sent_back_evenly_reaches_each_place_alike(sphere, log_scale):
    light, places, albedo = sphere
    dull = Albedo(albedo.scaled(log_scale).base_color + albedo.glossy, 0 * albedo.glossy)
    expected = series(BASE_COLOR * np.exp(log_scale) + GLOSSY) / RADIUS_MM**2
    bounced = light.at(places, n=0.0, q=2.0, albedo=dull)
    np.testing.assert_allclose(bounced, expected, rtol=0.05)
    assert bounced.mean() == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("log_scale", [0.0, 0.3])
def test_base_color_sends_light_back_evenly_and_gloss_head_on_light_across(sphere, log_scale):
    """Both in the same amount as ever after; at first lobes send their share of head-on light back."""
    light, places, albedo = sphere
    bounced = light.at(places, n=0.0, q=2.0, albedo=albedo.scaled(log_scale)) * RADIUS_MM**2
    color, white = BASE_COLOR * np.exp(log_scale), GLOSSY * HEAD_ON
    mean = (color + white) / (1 - color - GLOSSY) / 2
    assert bounced.mean() == pytest.approx(mean, rel=0.01)
    z_mm = places.weights @ light._radiosity.centre_mm[:, 2]
    lit, dark = (bounced[side].mean() for side in (z_mm > RADIUS_MM / 2, z_mm < -RADIUS_MM / 2))
    assert dark - lit > white / 2


def test_one_view_is_as_one_of_several(sphere):
    light, places, albedo = sphere
    several = light.at(places, 1.0, 2.0, albedo.scaled(0.0))
    alone = Places(places.weights, 0 * places.view).of(np.ones((places.weights.shape[1], 1, 3)))
    np.testing.assert_allclose(alone, 1, rtol=1e-6)
    np.testing.assert_allclose(several[::2].mean(), several[1::2].mean(), rtol=0.01)


def test_what_points_mirror_is_tissue_without_what_its_own_lobes_make_of_direct_light(sphere):
    """The lens looks from the centre, straight ahead at a place that facets mirror to the other side, which
    no light reaches but what bounces; those steeper than π/8 (Walter et al. 2007, eq. 35) to the lit side."""
    light, places, albedo = sphere
    found = light.expanded(places, 0.0, 2.0, albedo, torch.zeros(len(places.view)))
    z_mm = places.weights @ light._radiosity.centre_mm[:, 2]
    arriving, mirrored = (places.of(each) for each in light.between(0.0, 2.0, albedo))
    np.testing.assert_allclose(found.surroundings, mirrored / arriving, rtol=1e-5)
    ahead, behind = z_mm > 0.9 * RADIUS_MM, z_mm < -0.9 * RADIUS_MM
    dark = (BASE_COLOR + GLOSSY) * arriving[behind].mean()
    steep = 1 / (1 + (np.tan(np.pi / 8) / ROUGHNESS_TISSUE**2) ** 2)
    expected = dark + steep * BASE_COLOR / RADIUS_MM**2
    assert mirrored[ahead].mean() == pytest.approx(expected, rel=0.03)
    np.testing.assert_allclose(mirrored[behind], arriving[behind], rtol=1e-5)
    there = found.irradiance(0.0, 2.0)
    torch.testing.assert_close(found.mirrored(there), there * found.surroundings)


def test_without_white_lobes_points_are_as_if_light_came_from_all_around(sphere):
    light, places, albedo = sphere
    dull = Albedo(albedo.base_color, 0 * albedo.glossy)
    arriving, mirrored = light.between(0.5, 2.0, dull)
    np.testing.assert_array_equal(arriving, mirrored)
    assert light.expanded(places, 0.5, 2.0, albedo).surroundings is None


def test_the_expansion_is_exact_where_it_was_made_and_follows_the_light(sphere):
    light, places, albedo = sphere
    gloss = torch.zeros(len(places.view))
    bounce = light.expanded(places, 0.5, 2.0, albedo, gloss, log_scale=0.1)
    here = light.at(places, 0.5, 2.0, albedo.scaled(0.1))
    np.testing.assert_allclose(bounce.irradiance(0.5, 2.0, 0.1), here, rtol=1e-4)
    np.testing.assert_allclose(bounce.by_q, -np.log(RADIUS_MM), rtol=0.01)
    moved = light.at(places, 0.55, 1.95, albedo.scaled(0.15))
    np.testing.assert_allclose(bounce.irradiance(0.55, 1.95, 0.15), moved, rtol=0.01)


def test_no_points_have_an_expansion_too(sphere):
    light, places, albedo = sphere
    none = Places(places.weights[:0], places.view[:0])
    bounce = light.expanded(none, 0.5, 2.0, albedo, torch.zeros(0), seen_by=(0.45, albedo))
    assert bounce.irradiance(0.5, 2.0).shape == (0, 3) and bounce.by_q.shape == (0,)


def test_the_expansion_by_the_scale_alone_is_exact_there_too_and_still_in_all_else(sphere):
    light, places, albedo = sphere
    whole, part = (
        light.expanded(places, 0.5, 2.0, albedo, torch.zeros(len(places.view)), log_scale=0.1, by=by)
        for by in (BOUNCES_BY, ["scale"])
    )
    for scale in (0.1, 0.2):
        torch.testing.assert_close(part.irradiance(0.5, 2.0, scale), whole.irradiance(0.5, 2.0, scale))
    assert (part.irradiance(0.9, 1.5, 0.1) == part.irradiance(0.5, 2.0, 0.1)).all()


def test_the_expansion_follows_the_response_through_which_photos_tell_the_albedo(sphere):
    """The same photos tell of brighter tissue where γ is larger."""
    light, places, albedo = sphere
    gamma, gloss = 0.45, torch.zeros(len(places.view))

    def told(other: float) -> Albedo:
        return Albedo(albedo.base_color ** (gamma / other), albedo.glossy)

    bounce = light.expanded(places, 0.5, 2.0, albedo, gloss, seen_by=(gamma, told(gamma + GAMMA_STEP)))
    for other in (gamma, gamma + GAMMA_STEP):
        there = light.at(places, 0.5, 2.0, told(other).scaled(0.0))
        np.testing.assert_allclose(bounce.irradiance(0.5, 2.0, gamma=other), there, rtol=1e-4)
    assert (bounce.by_gamma > 0.5).all()

"""Form factors and bounced light against closed forms."""

import numpy as np
import pytest
import trimesh

from endotwin.fusion.mesh import surface_of
from endotwin.light.guides import COSINE
from endotwin.light.radiosity import BOUNCES, Radiosity
from endotwin.surface.casting import Caster

RADIUS_MM = 10.0


@pytest.fixture(scope="module")
def hollow_sphere():
    ball = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS_MM)
    return surface_of(np.zeros(3), np.asarray(ball.vertices, np.float32), ball.faces[:, ::-1])


@pytest.fixture(scope="module")
def sphere(hollow_sphere):
    return Radiosity(hollow_sphere, Caster(hollow_sphere), cell_mm=3.0)


def test_every_ray_inside_a_closed_surface_lands_on_it(sphere):
    np.testing.assert_allclose(sphere.form_factors.sum(axis=1), 1, atol=0.01)


def test_form_factors_of_a_sphere_are_the_shares_of_its_area(sphere, hollow_sphere):
    """Inside a sphere every patch sees each other one by its share of the area (Goral et al. 1984)."""
    corners = hollow_sphere.vertices_mm[hollow_sphere.triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    share = np.bincount(sphere.patch_of, area) / area.sum()
    received = np.asarray(sphere.form_factors.mean(axis=0)).ravel()
    assert np.corrcoef(share, received)[0, 1] > 0.98
    np.testing.assert_allclose(received.sum(), 1, atol=0.01)


@pytest.mark.parametrize("albedo", [0.2, 0.5, 0.8])
def test_light_at_the_centre_of_a_sphere_bounces_to_the_geometric_series(sphere, albedo):
    """E = E_direct·(ρ + ρ² + …), cut after BOUNCES terms (Ulbricht's integrating sphere)."""
    light = np.ones((sphere.count, 1), np.float32)
    bounced = sphere.indirect(light, np.full((sphere.count, 3), albedo))
    series = sum(albedo**k for k in range(1, BOUNCES + 1))
    np.testing.assert_allclose(bounced, series, rtol=0.02)


def test_a_lamp_at_the_centre_lights_a_sphere_evenly(sphere):
    lamp = sphere.lamp(np.eye(4), np.zeros(3), COSINE)
    direct = sphere.direct([lamp], n=0.0, q=2.0)
    np.testing.assert_allclose(direct, RADIUS_MM**-2.0, rtol=0.02)


def test_colour_bleeds_by_channel(sphere):
    light = np.ones((sphere.count, 1), np.float32)
    bounced = sphere.indirect(light, np.tile([0.8, 0.4, 0.0], (sphere.count, 1)))
    assert bounced[..., 0].mean() > bounced[..., 1].mean() > bounced[..., 2].max() == 0


def test_interpolation_to_vertices_keeps_a_constant(sphere):
    np.testing.assert_allclose(sphere.to_vertex @ np.ones(sphere.count), 1, rtol=1e-6)

"""Form factors and bounced light against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from endotwin.fusion.mesh import surface_of
from endotwin.light.guides import COSINE, EXPONENTIAL
from endotwin.light.radiosity import LEAST_AREA, Radiosity
from endotwin.surface.casting import Caster

RADIUS_MM = 10.0


@pytest.fixture(scope="module")
def hollow_sphere():
    ball = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS_MM)
    return surface_of(np.zeros(3), np.asarray(ball.vertices, np.float32), ball.faces[:, ::-1])


@pytest.fixture(scope="module")
def sphere(hollow_sphere):
    return Radiosity(hollow_sphere, Caster(hollow_sphere), cell_mm=3.0)


def all_around(radiosity):
    """Two lamps at the origin, back to back."""
    back = np.diag([1.0, -1, -1, 1])
    return [radiosity.lamp(pose, np.zeros(3), COSINE) for pose in (np.eye(4), back)]


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
    """E = E_direct·(ρ + ρ² + …) to the end (Ulbricht's integrating sphere)."""
    light = np.ones((sphere.count, 1), np.float32)
    bounced = sphere.indirect(light, np.full((sphere.count, 3), albedo))
    np.testing.assert_allclose(bounced, albedo / (1 - albedo), rtol=0.02)


@pytest.mark.parametrize("albedo", [0.3, 0.6])
def test_half_a_sphere_gets_nearly_the_bounce_of_the_whole_from_what_nobody_saw(hollow_sphere, albedo):
    """A cos² beam from the centre lights one half only: E = ρ/(1 − ρ)·(mean of E_direct) on the whole."""
    centre = hollow_sphere.vertices_mm[hollow_sphere.triangles].mean(axis=1)
    seen = replace(hollow_sphere, triangles=hollow_sphere.triangles[centre[:, 2] > 0])
    half = Radiosity(seen, Caster(seen), cell_mm=3.0)
    direct = half.direct([half.lamp(np.eye(4), np.zeros(3), COSINE)], n=2.0, q=2.0)
    true = albedo / (1 - albedo) * RADIUS_MM**-2.0 / 6
    bounced = half.indirect(direct, np.full((half.count, 3), albedo))
    half.unseen = np.zeros_like(half.unseen)
    without = half.indirect(direct, np.full((half.count, 3), albedo))
    assert np.mean(bounced) == pytest.approx(true, rel=0.2)
    assert abs(np.mean(bounced) - true) < abs(np.mean(without) - true) / 2


@pytest.mark.parametrize("albedo", [0.3, 0.6])
def test_half_a_sphere_whose_wall_is_the_other_half_gets_the_bounce_of_the_whole(hollow_sphere, albedo):
    centre = hollow_sphere.vertices_mm[hollow_sphere.triangles].mean(axis=1)
    seen, other = (hollow_sphere.triangles[side] for side in (centre[:, 2] > 0, centre[:, 2] <= 0))
    walled = replace(hollow_sphere, triangles=seen, wall_mm=hollow_sphere.vertices_mm, wall_triangles=other)
    half = Radiosity(walled, Caster(walled), cell_mm=3.0)
    direct = half.direct([half.lamp(np.eye(4), np.zeros(3), COSINE)], n=2.0, q=2.0)
    bounced = half.indirect(direct, np.full((half.count, 3), albedo))[: half.count]
    true = albedo / (1 - albedo) * RADIUS_MM**-2.0 / 6
    assert bounced.mean() == pytest.approx(true, rel=0.02)
    assert bounced.std() < 0.1 * true
    assert bounced.shape == (half.count, 1, 3)


def test_tissue_that_no_photo_saw_sends_back_as_much_as_what_was_seen_beside_it(hollow_sphere):
    """E = E_direct·ρ/(1 − ρ), ρ that of the half that was seen, whatever the other's is taken for."""
    albedo, upper = 0.6, (hollow_sphere.vertices_mm[:, 2] > 0).astype(np.int32)
    half = hollow_sphere.with_coverage(upper, hollow_sphere.nearest_mm)
    radiosity = Radiosity(half, Caster(half), cell_mm=3.0)
    color = radiosity.mean(albedo * np.repeat(upper[half.triangles].min(axis=1)[:, None], 3, axis=1))
    bounced = radiosity.indirect(np.ones((radiosity.count, 1), np.float32), color)
    np.testing.assert_allclose(bounced, albedo / (1 - albedo), rtol=0.02)


def test_nothing_of_the_wall_lies_in_the_way_of_light_to_the_surface(hollow_sphere):
    inner = replace(
        hollow_sphere,
        wall_mm=0.5 * hollow_sphere.vertices_mm,
        wall_triangles=hollow_sphere.triangles[:, ::-1],
    )
    radiosity = Radiosity(inner, Caster(inner), cell_mm=3.0)
    direct = radiosity.direct(all_around(radiosity), n=0.0, q=2.0).sum(axis=1)
    np.testing.assert_allclose(direct[: radiosity.count], RADIUS_MM**-2.0, rtol=0.02)


def test_no_patch_is_a_sliver(sphere, hollow_sphere):
    corners = hollow_sphere.vertices_mm[hollow_sphere.triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    assert np.bincount(sphere.patch_of, area).min() >= LEAST_AREA * sphere.cell_mm**2


@pytest.mark.parametrize("profile", [COSINE, EXPONENTIAL])
def test_a_lamp_at_the_centre_lights_the_half_of_a_sphere_that_it_faces(sphere, profile):
    lamp = sphere.lamp(np.eye(4), np.zeros(3), profile)
    direct, z_mm = sphere.direct([lamp], n=0.0, q=2.0)[:, 0], sphere.centre_mm[:, 2]
    np.testing.assert_allclose(direct[z_mm > 2], RADIUS_MM**-2.0, rtol=0.02)
    assert not direct[z_mm < -2].any()


def test_colour_bleeds_by_channel(sphere):
    light = np.ones((sphere.count, 1), np.float32)
    bounced = sphere.indirect(light, np.tile([0.8, 0.4, 0.0], (sphere.count, 1)))
    assert bounced[..., 0].mean() > bounced[..., 1].mean() > bounced[..., 2].max() == 0


def test_interpolation_to_vertices_keeps_a_constant(sphere):
    np.testing.assert_allclose(sphere.to_vertex @ np.ones(sphere.count), 1, rtol=1e-6)

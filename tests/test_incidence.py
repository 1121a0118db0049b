"""Incidence against the closed forms of a sphere seen from inside."""

import numpy as np
import pytest
import trimesh
from scenes import look, pinhole

from endotwin.light.incidence import COS_MIN, incidence
from endotwin.surface import Surface
from endotwin.surface.casting import Caster, Correspondences
from endotwin.surface.vectors import unit

RADIUS_MM = 15.0
ORIGIN_MM = np.array([300.0, -500.0, 900.0])


@pytest.fixture(scope="module")
def sphere() -> Surface:
    """A finely cut sphere about ORIGIN_MM with exact normals, seen from inside."""
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS_MM)
    inward = -mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    return Surface.from_mesh(mesh.vertices + ORIGIN_MM, mesh.faces[:, ::-1], inward)


def seen_from(sphere: Surface, eye_mm: np.ndarray, towards: np.ndarray):
    """Incidence of the view from ``eye_mm`` (relative to the sphere's centre) and world rays [N, 3]."""
    camera, T_world_camera = pinhole(64, 48), look(ORIGIN_MM + eye_mm, towards)
    hits = Caster(sphere).cast(camera, T_world_camera)
    assert len(hits) == 64 * 48
    view = camera.pixel_directions.reshape(-1, 3)[hits.pixel].astype(np.float64)
    return incidence(hits, sphere, camera, T_world_camera), view, view @ T_world_camera[:3, :3].T


def test_from_the_centre_of_a_sphere_every_ray_meets_the_surface_head_on(sphere):
    seen, view, _ = seen_from(sphere, np.zeros(3), np.array([0.3, -0.2, 1.0]))
    np.testing.assert_allclose(seen.cos, 1, atol=2e-6)
    assert seen.sin2.max() < 4e-6
    np.testing.assert_allclose(np.exp(seen.log_distance), RADIUS_MM, rtol=1e-3)
    np.testing.assert_allclose(np.exp(seen.log_cos_axis), view[:, 2], rtol=1e-5)


def test_off_the_centre_cosine_sine_and_distance_are_those_of_the_chord(sphere):
    """|eye + d·ω| = R gives d, and the inward normal at the hit is −(eye + d·ω)/R."""
    eye_mm = np.array([4.0, -3.0, 9.0])
    seen, _, ray = seen_from(sphere, eye_mm, np.array([-1.0, 0.5, 0.2]))
    along = ray @ eye_mm
    distance_mm = -along + np.sqrt(along**2 + RADIUS_MM**2 - eye_mm @ eye_mm)
    cos = ((eye_mm + distance_mm[:, None] * ray) * ray).sum(axis=1) / RADIUS_MM
    np.testing.assert_allclose(np.exp(seen.log_distance), distance_mm, rtol=2e-3)
    np.testing.assert_allclose(seen.cos, cos, atol=2e-3)
    np.testing.assert_allclose(seen.sin2, 1 - cos**2, atol=3e-3)
    np.testing.assert_allclose(seen.cos**2 + seen.sin2, 1, atol=1e-6)


def test_sine_squared_is_exact_in_float32_down_to_a_hundredth_of_a_degree():
    """1 − cos² in float32 would round sin² = 3e-8 to 0 or 6e-8."""
    camera = pinhole(3, 3)
    degrees = np.logspace(-2, 1.5, 9)
    tilt = np.radians(degrees)
    view = camera.pixel_directions[1, 1].astype(np.float64)
    normals = np.stack([np.sin(tilt), 0 * tilt, -np.cos(tilt)], axis=1)
    vertices = np.tile([[-1.0, -1, 5], [1, -1, 5], [0, 1, 5]], (9, 1))
    surface = Surface.from_mesh(vertices, np.arange(27).reshape(9, 3), np.repeat(normals, 3, axis=0))
    centre = np.full((9, 3), 1 / 3, np.float32)
    hits = Correspondences(
        np.full(9, 4, np.int32), np.arange(9, dtype=np.int32), centre, np.full(9, 5, np.float32)
    )
    seen = incidence(hits, surface, camera, np.eye(4))
    exact = np.linalg.norm(np.cross(surface.normals[::3].astype(np.float64), view), axis=1) ** 2
    np.testing.assert_allclose(seen.sin2, exact, rtol=2e-3)
    np.testing.assert_allclose(seen.sin2, np.sin(tilt) ** 2, rtol=2e-3)


def test_a_surface_that_faces_away_keeps_finite_logarithms():
    camera = pinhole(3, 3)
    surface = Surface.from_mesh(
        np.array([[-1.0, -1, 5], [1, -1, 5], [0, 1, 5]]), np.array([[0, 1, 2]]), np.tile([0, 0, 1.0], (3, 1))
    )
    one = np.ones(1, np.float32)
    hits = Correspondences(np.array([4]), np.array([0]), np.array([[1, 0, 0]], np.float32), 0 * one)
    seen = incidence(hits, surface, camera, np.eye(4))
    assert seen.cos[0] == np.float32(COS_MIN)
    assert all(np.isfinite(value).all() for value in vars(seen).values())


def test_unit_scales_vectors_and_leaves_zero_alone():
    vectors = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32) * 1e-12
    vectors[3] = 0
    lengths = np.linalg.norm(unit(vectors), axis=1)
    assert lengths[3] == 0
    np.testing.assert_allclose(np.delete(lengths, 3), 1, rtol=1e-6)

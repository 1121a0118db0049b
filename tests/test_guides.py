"""Light beside the lens, against the light at the lens and an analytic shadow."""

import numpy as np
import pytest
import trimesh

from endotwin.fusion.mesh import surface_of
from endotwin.light.guides import AT_LENS, COSINE, EXPONENTIAL, guided, log_axis, visible_from
from endotwin.surface.casting import Caster
from endotwin.surface.vectors import dot, unit

RADIUS_MM, CENTRE_MM, WALL_MM = 2.0, 10.0, 20.0


@pytest.fixture(scope="module")
def points() -> tuple[np.ndarray, np.ndarray]:
    """Points before the camera [N, 3], and unit normals that face it."""
    generator = np.random.default_rng(0)
    points_mm = generator.normal((0, 0, 20), 4, (500, 3))
    normals = unit(-points_mm + generator.normal(0, 4, (500, 3)))
    facing = dot(normals, -points_mm) > 0
    return points_mm[facing].astype(np.float32), normals[facing].astype(np.float32)


def test_a_guide_at_the_lens_is_the_light_at_the_lens(points):
    points_mm, normals = points
    lit = guided(points_mm, normals, np.zeros((1, 3)), COSINE)
    view = unit(points_mm)
    np.testing.assert_allclose(lit.cos_i[:, 0], -dot(normals, view), atol=1e-6)
    np.testing.assert_allclose(lit.cos_d[:, 0], 1, atol=1e-6)
    np.testing.assert_allclose(lit.sin2_m[:, 0], 1 - dot(normals, view) ** 2, atol=1e-5)
    np.testing.assert_allclose(lit.log_axis[:, 0], np.log(view[:, 2]), atol=1e-5)
    np.testing.assert_allclose(lit.log_distance[:, 0], np.log(np.linalg.norm(points_mm, axis=1)), atol=1e-6)


def test_both_profiles_fall_alike_near_the_axis(points):
    """ln cosθ and cosθ − 1 agree to second order in θ."""
    points_mm, normals = points
    cosine, exponential = (
        guided(points_mm, normals, AT_LENS, profile).log_axis[:, 0].numpy()
        for profile in (COSINE, EXPONENTIAL)
    )
    narrow = cosine > -0.02
    np.testing.assert_allclose(cosine[narrow], exponential[narrow], atol=2e-4)
    assert (cosine <= exponential + 1e-6).all()


def test_a_mixed_profile_is_the_product_of_both_shapes():
    cos_axis, n, share = np.linspace(0.01, 1, 50), 2.5, 0.3
    shape = np.exp(n * log_axis(cos_axis, share))
    product = cos_axis ** (n * (1 - share)) * np.exp(-n * share * (1 - cos_axis))
    np.testing.assert_allclose(shape, product, rtol=1e-12)


def test_a_guide_behind_the_surface_gives_no_light(points):
    points_mm, normals = points
    lit = guided(points_mm, -normals, AT_LENS, COSINE)
    assert (lit.cos_i == 0).all()


def test_a_ball_before_a_wall_throws_its_analytic_shadow():
    """The shadow of a ball is the cone of its tangents: sin of the half angle = radius / distance."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS_MM).apply_translation([0, 0, CENTRE_MM])
    wall = trimesh.Trimesh([[-30, -30, WALL_MM], [30, -30, WALL_MM], [0, 40, WALL_MM]], [[0, 1, 2]])
    both = trimesh.util.concatenate([ball, wall])
    surface = surface_of(np.zeros(3), np.asarray(both.vertices, np.float32), both.faces)
    guide_mm = np.array([3.0, 0.0, 0.0])
    x, y = np.meshgrid(np.linspace(-8, 4, 61), np.linspace(-5, 5, 51))
    points_mm = np.stack([x, y, np.full_like(x, WALL_MM)], axis=-1).reshape(-1, 3).astype(np.float32)
    seen = visible_from(Caster(surface), np.eye(4), points_mm, guide_mm[None])[:, 0] > 0
    towards = np.array([0, 0, CENTRE_MM]) - guide_mm
    distance_mm = np.linalg.norm(towards)
    cos = unit(points_mm - guide_mm) @ (towards / distance_mm)
    half_angle = np.arcsin(RADIUS_MM / distance_mm)
    clear = np.abs(np.arccos(cos) - half_angle) > 0.01
    np.testing.assert_array_equal(seen[clear], (np.arccos(cos) > half_angle)[clear])
    assert 0.05 < (~seen).mean() < 0.5

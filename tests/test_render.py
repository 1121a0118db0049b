"""Rendered views against closed forms: a sphere seen from inside, a plane seen head-on."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from scenes import look, pinhole

from endotwin.effects import Effects
from endotwin.effects.coat import Coat
from endotwin.effects.specular import Specular
from endotwin.errors import TwinError
from endotwin.render import Renderer
from endotwin.surface import Surface
from endotwin.twin import Light, Materials, Response, Source, Twin

RADIUS_MM, PLANE_MM, HALF_MM = 15.0, 20.0, 8.0
CENTRE_MM = np.array([100.0, -200.0, 300.0])
CAMERA = pinhole(96, 72)
LIGHT, GAMMA, F0 = Light(L0=38.0, n=1.7, q=1.9), 0.47, 0.06


def base_color(points: np.ndarray) -> np.ndarray:
    """A smooth pattern [N, 3] of points [N, 3]."""
    wave = np.sin(points @ np.array([0.3, -0.2, 0.25]))
    return 0.4 + np.stack([0.3 * wave, -0.2 * wave, 0.1 * wave], axis=-1)


def roughness(points: np.ndarray) -> np.ndarray:
    return 0.5 + 0.2 * np.cos(points @ np.array([0.1, 0.2, -0.15]))


def twin_of(surface: Surface, diffuse: str = "burley", metallic: float = 0.0, L0: float = LIGHT.L0) -> Twin:
    local = surface.vertices_mm + surface.origin_mm - CENTRE_MM
    materials = Materials(
        base_color(local).astype(np.float32),
        roughness(local).astype(np.float32),
        np.full(len(local), metallic, np.float32),
        F0,
        diffuse,
    )
    light = Light(L0, LIGHT.n, LIGHT.q)
    return Twin(surface, CAMERA, Source("none", "c3vd"), materials, light, Response(GAMMA))


@pytest.fixture(scope="module")
def sphere() -> Surface:
    mesh = trimesh.creation.icosphere(subdivisions=6, radius=RADIUS_MM)
    inward = -mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    return Surface.from_mesh(mesh.vertices + CENTRE_MM, mesh.faces[:, ::-1], inward)


@pytest.fixture(scope="module")
def plane() -> Surface:
    """A square ahead of a camera at CENTRE_MM."""
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * HALF_MM + [0, 0, PLANE_MM]
    return Surface.from_mesh(
        corners + CENTRE_MM, np.array([[0, 2, 1], [0, 3, 2]]), np.tile([0, 0, -1.0], (4, 1))
    )


def at_centre() -> np.ndarray:
    T_world_camera = np.eye(4)
    T_world_camera[:3, 3] = CENTRE_MM
    return T_world_camera


def photo(points, cos, cos_axis, distance, diffuse: str, metallic: float) -> np.ndarray:
    """(f·L·(n·ω)·2π)^γ with wi = wo (Han & Wu 2025; Burley 2012; Walter et al. 2007), [N, 3]."""
    r = roughness(points)
    alpha2 = r**4
    peak = alpha2 / (np.pi * (cos**2 * (alpha2 - 1) + 1) ** 2)
    g1 = 2 / (1 + np.sqrt(1 + alpha2 * (1 / cos**2 - 1)))
    lobe = base_color(points) * (1 - metallic) / np.pi
    if diffuse == "burley":
        lobe = lobe * ((1 + (2 * r - 0.5) * (1 - cos) ** 5) ** 2)[:, None]
    reflected = lobe + (F0 * peak * g1**2 / (4 * cos**2))[:, None]
    light = LIGHT.L0 * cos_axis**LIGHT.n / distance**LIGHT.q
    return np.clip((reflected * (light * cos * 2 * np.pi)[:, None]) ** GAMMA, 0, 1)


@pytest.mark.parametrize("diffuse, metallic", [("burley", 0.0), ("lambert", 0.3)])
def test_a_sphere_from_inside_looks_as_its_closed_form(sphere, diffuse, metallic):
    eye = np.array([5.0, -4.0, 6.0])
    T_world_camera = look(CENTRE_MM + eye, (-0.4, 0.6, 1.0))
    view = Renderer(twin_of(sphere, diffuse, metallic)).view(T_world_camera)
    rays = CAMERA.pixel_directions.reshape(-1, 3).astype(np.float64)
    world = rays @ T_world_camera[:3, :3].T
    along = world @ eye
    distance = -along + np.sqrt(along**2 + RADIUS_MM**2 - eye @ eye)
    points = eye + distance[:, None] * world
    cos = (points * world).sum(axis=1) / RADIUS_MM
    expected = photo(points, cos, rays[:, 2], distance, diffuse, metallic)
    assert view.mask.all() and 0.2 < np.median(expected) < 0.9
    np.testing.assert_allclose(view.color.reshape(-1, 3), expected, atol=1 / 255)
    np.testing.assert_allclose(view.depth_mm.reshape(-1), distance * rays[:, 2], rtol=5e-4)
    inward = -points @ T_world_camera[:3, :3] / RADIUS_MM
    np.testing.assert_allclose(view.normals.reshape(-1, 3), inward, atol=2e-3)


def test_depth_is_along_the_axis_and_not_along_the_ray(plane):
    view = Renderer(twin_of(plane)).view(at_centre())
    assert 0.1 < view.mask.mean() < 0.9
    np.testing.assert_allclose(view.depth_mm[view.mask], PLANE_MM, rtol=1e-5)
    assert view.hits.distance_mm.max() > 1.08 * PLANE_MM
    np.testing.assert_allclose(
        view.normals[view.mask], np.tile([0, 0, -1.0], (view.mask.sum(), 1)), atol=1e-6
    )


def test_pixels_off_the_surface_are_black_without_depth_or_normal(plane):
    view = Renderer(twin_of(plane)).view(at_centre())
    rays = CAMERA.pixel_directions
    inside = (np.abs(rays[..., :2] / rays[..., 2:]) < HALF_MM / PLANE_MM).all(axis=-1)
    np.testing.assert_array_equal(view.mask, inside)
    assert (view.color[inside] > 0).all() and not view.color[~inside].any()
    assert np.isnan(view.depth_mm[~inside]).all() and np.isfinite(view.depth_mm[inside]).all()
    assert not view.normals[~inside].any()


def test_a_slit_narrower_than_a_pixel_is_no_black_line(plane):
    column, row = 40, 30
    slope, beside = (
        CAMERA.pixel_directions[row, c, 0] / CAMERA.pixel_directions[row, c, 2] for c in (column, column + 1)
    )
    slit_mm = PLANE_MM * (slope + 0.2 * np.array([-1, 1]) * (beside - slope))
    left, right = (plane.vertices_mm + plane.origin_mm - CENTRE_MM for _ in range(2))
    left[left[:, 0] > 0, 0], right[right[:, 0] < 0, 0] = slit_mm
    vertices = np.concatenate([left, right]) + CENTRE_MM
    triangles = np.concatenate([plane.triangles, plane.triangles + 4])
    slit = Surface.from_mesh(vertices, triangles, np.tile([0, 0, -1.0], (8, 1)))
    view = Renderer(twin_of(slit)).view(at_centre())
    assert not view.mask[row, column] and view.mask[row, column + 1]
    np.testing.assert_allclose(view.color[row, column], view.color[row, column + 1], rtol=0.05)


@pytest.mark.parametrize(("gap_px", "closed"), [(1, True), (2, True), (3, False)])
def test_a_gap_of_one_or_two_pixels_is_no_black_line_and_a_wider_one_is(plane, gap_px, closed):
    row, first = 30, 40
    slopes = CAMERA.pixel_directions[row, :, 0] / CAMERA.pixel_directions[row, :, 2]
    left, right = (plane.vertices_mm + plane.origin_mm - CENTRE_MM for _ in range(2))
    left[left[:, 0] > 0, 0] = PLANE_MM * (slopes[first - 1] + slopes[first]) / 2
    right[right[:, 0] < 0, 0] = PLANE_MM * (slopes[first + gap_px - 1] + slopes[first + gap_px]) / 2
    triangles = np.concatenate([plane.triangles, plane.triangles + 4])
    vertices = np.concatenate([left, right]) + CENTRE_MM
    gap = Surface.from_mesh(vertices, triangles, np.tile([0, 0, -1.0], (8, 1)))
    view = Renderer(twin_of(gap)).view(at_centre())
    within = slice(first, first + gap_px)
    assert not view.mask[row, within].any() and np.isnan(view.depth_mm[row, within]).all()
    assert view.color[row, within].any(axis=-1).all() == closed


def with_back_of_a_sliver(plane: Surface, width_px: float) -> Surface:
    """The plane with a narrow strip before its middle that shows the camera its back."""
    half = width_px / 2 / CAMERA.fx * (PLANE_MM - 1)
    x, y = np.array([-half, half, half, -half]), np.array([-3.0, -3, 3, 3])
    strip = np.stack([x, y, np.full(4, PLANE_MM - 1)], axis=1) + CENTRE_MM - plane.origin_mm
    count = len(plane.vertices_mm)
    return Surface.from_mesh(
        np.concatenate([plane.vertices_mm, strip]) + plane.origin_mm,
        np.concatenate([plane.triangles, count + np.array([[0, 2, 1], [0, 3, 2]])]),
        np.concatenate([plane.normals, np.tile([[0, 0, 1.0]], (4, 1))]),
    )


@pytest.mark.parametrize("width_px", (0.5, 1.5))
def test_the_back_of_a_sliver_is_no_black_dot(plane, width_px):
    before = Renderer(twin_of(plane)).view(look(CENTRE_MM, [0, 0, 1]))
    view = Renderer(twin_of(with_back_of_a_sliver(plane, width_px))).view(look(CENTRE_MM, [0, 0, 1]))
    assert (view.depth_mm < PLANE_MM - 0.5).sum() > 10 or width_px < 1
    np.testing.assert_allclose(view.color, before.color, atol=0.02)


def test_a_wall_that_is_seen_from_behind_all_over_stays_dark(plane):
    turned = Surface.from_mesh(plane.vertices_mm + plane.origin_mm, plane.triangles, -plane.normals)
    view = Renderer(twin_of(turned)).view(look(CENTRE_MM, [0, 0, 1]))
    assert view.mask.any() and view.color.max() < 0.05


def test_a_mask_limits_the_view_and_changes_nothing_within(sphere):
    renderer = Renderer(twin_of(sphere))
    whole = renderer.view(at_centre())
    mask = np.random.default_rng(0).random(whole.shape) < 0.3
    part = renderer.view(at_centre(), mask)
    np.testing.assert_array_equal(part.mask, mask)
    np.testing.assert_array_equal(part.depth_mm[mask], whole.depth_mm[mask])
    np.testing.assert_array_equal(part.normals[mask], whole.normals[mask])
    # Pixels at the mask's edge may be means over their area, on this smooth wall close to the centre's value.
    np.testing.assert_allclose(part.color[mask], whole.color[mask], atol=0.25 / 255)
    assert not part.color[~mask].any()


def test_light_that_is_too_strong_clips_at_one_and_none_is_black(sphere):
    assert (Renderer(twin_of(sphere, L0=1e9)).view(at_centre()).color == 1).all()
    assert Renderer(twin_of(sphere, L0=0.0)).view(at_centre()).color.max() < 1 / 255


def test_twice_the_light_is_twice_the_radiance(sphere):
    one = Renderer(twin_of(sphere, L0=8.0)).view(at_centre()).color
    two = Renderer(twin_of(sphere, L0=16.0)).view(at_centre()).color
    assert two.max() < 1
    np.testing.assert_allclose((two / one) ** (1 / GAMMA), 2, rtol=0.02)


def test_a_highlight_sharper_than_a_pixel_is_the_mean_over_its_area(plane):
    twin = replace(twin_of(plane, L0=0.2 * LIGHT.L0), effects=Effects([Specular(), Coat(0.2, 0.1)]))
    view, fine = (Renderer(twin, CAMERA.scaled(factor)).view(at_centre()) for factor in (1, 15))
    inside = cv2.erode(view.mask.astype(np.uint8), np.ones((3, 3))) > 0
    areas = fine.radiance.reshape(CAMERA.height, 15, CAMERA.width, 15, 3).mean(axis=(1, 3))
    mean, centre = (values[inside] ** GAMMA for values in (areas, fine.radiance[7::15, 7::15]))
    assert np.abs(view.color[inside] - mean).max() < 2 / 255
    assert np.abs(centre - mean).max() > 8 / 255
    assert 0 < view.averaged[inside].mean() < 0.05


def test_another_camera_sees_the_same_surface(plane):
    small = pinhole(48, 36)
    view = Renderer(twin_of(plane), small).view(at_centre())
    assert view.color.shape == (36, 48, 3)
    np.testing.assert_allclose(view.depth_mm[view.mask], PLANE_MM, rtol=1e-5)


def test_an_unfitted_twin_cannot_be_rendered(plane):
    with pytest.raises(TwinError, match="endotwin fit"):
        Renderer(Twin(plane, CAMERA, Source("none", "c3vd")))

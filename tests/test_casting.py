"""Embree hits against Open3D's ray caster and against geometry."""

from dataclasses import replace

import numpy as np
import pytest
import scenes

from endotwin.fusion._open3d import o3c, o3d
from endotwin.surface import Surface, embree
from endotwin.surface.casting import Caster


def sphere_surface(radius_mm: float = 15.0, centre_mm: float = 0.0) -> Surface:
    """A sphere seen from inside: triangles and normals face its centre."""
    mesh = o3d.geometry.TriangleMesh.create_sphere(radius_mm, 40)
    vertices, triangles = np.asarray(mesh.vertices), np.asarray(mesh.triangles)[:, ::-1]
    return Surface.from_mesh(vertices + centre_mm, triangles, -vertices / radius_mm)


@pytest.fixture(scope="module")
def surface():
    return sphere_surface()


def random_rays(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    origins = rng.uniform(-8, 8, (count, 3)).astype(np.float32)
    directions = rng.standard_normal((count, 3)).astype(np.float32)
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def test_hits_are_those_of_open3d(surface):
    origins, directions = random_rays(100_000)
    origins[::7] *= 4
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3c.Tensor(surface.vertices_mm), o3c.Tensor(surface.triangles.astype(np.uint32)))
    expected = scene.cast_rays(o3c.Tensor(np.concatenate([origins, directions], axis=1)))
    triangle, barycentric, distance_mm = Caster(surface).cast_rays(origins, directions)
    hit = np.isfinite(expected["t_hit"].numpy())
    assert 0.5 < hit.mean() < 1
    np.testing.assert_array_equal(triangle >= 0, hit)
    np.testing.assert_allclose(distance_mm[hit], expected["t_hit"].numpy()[hit], rtol=1e-4, atol=1e-4)
    same = hit & (triangle == expected["primitive_ids"].numpy().astype(np.int64))
    assert same.sum() > 0.999 * hit.sum()
    np.testing.assert_allclose(barycentric[same, 1:], expected["primitive_uvs"].numpy()[same], atol=2e-3)


def test_barycentrics_give_back_the_hit_point(surface):
    origins, directions = random_rays(20_000)
    triangle, barycentric, distance_mm = Caster(surface).cast_rays(origins, directions)
    points = np.einsum("nk,nka->na", barycentric, surface.vertices_mm[surface.triangles[triangle]])
    np.testing.assert_allclose(points, origins + distance_mm[:, None] * directions, atol=1e-3)
    np.testing.assert_allclose(barycentric.sum(axis=1), 1, atol=1e-6)
    assert (barycentric >= 0).all()


def swollen(surface: Surface, share: float) -> Surface:
    """The surface with a wave along z, and aside: what motion does to tissue."""
    wave = 1 + share * np.sin(surface.vertices_mm[:, 2:])
    moved = surface.vertices_mm * wave + np.float32([5 * share, 0, 0])
    return replace(surface, vertices_mm=moved.astype(np.float32))


@pytest.mark.parametrize("known", [True, False], ids=["refitted", "built anew"])
def test_a_moved_casters_hits_are_those_of_a_new_one_whatever_it_was_before(surface, known, monkeypatch):
    if not known:
        monkeypatch.setattr(embree, "loaded", lambda: None)
    origins, directions = random_rays(50_000)
    caster = Caster(surface)
    for share in (0.3, -0.2, 0.1):
        there = swollen(surface, share)
        caster = caster.moved(there)
        assert (caster._refit is not None) == known
        assert caster.surface is there
        expected = Caster(there)
        for found, right in zip(
            caster.cast_rays(origins, directions), expected.cast_rays(origins, directions), strict=True
        ):
            np.testing.assert_array_equal(found, right)
        length_mm = np.full(len(origins), 14, np.float32)
        np.testing.assert_array_equal(
            caster.unobstructed(origins, directions, length_mm),
            expected.unobstructed(origins, directions, length_mm),
        )


def test_what_is_hit_on_shared_edges_does_not_depend_on_where_a_moved_caster_was_before(surface):
    """Rays at vertices of the moved surface hit one of six triangles: always the same one."""
    there = swollen(surface, 0.1)
    towards = there.vertices_mm / np.linalg.norm(there.vertices_mm, axis=1, keepdims=True)
    origins = np.zeros_like(towards)
    one, other = Caster(surface).moved(there), Caster(surface).moved(swollen(surface, -0.3)).moved(there)
    np.testing.assert_array_equal(one.cast_rays(origins, towards)[0], other.cast_rays(origins, towards)[0])


def test_no_ray_slips_through_shared_edges_and_vertices(surface):
    rng = np.random.default_rng(1)
    corners = surface.vertices_mm[surface.triangles]
    chosen = rng.integers(0, len(corners), 1_000_000)
    t = rng.uniform(0, 1, (len(chosen), 1)).round(1).astype(np.float32)
    targets = (1 - t) * corners[chosen, 0] + t * corners[chosen, 1]
    origins = np.broadcast_to(np.array([1.0, -2.0, 0.5], np.float32), targets.shape)
    directions = targets - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    triangle, _, _ = Caster(surface).cast_rays(origins, directions)
    assert (triangle >= 0).all()


def test_rays_that_are_not_finite_hit_nothing_and_leave_the_others_alone(surface):
    origins, directions = random_rays(1000)
    expected = Caster(surface).cast_rays(origins, directions)
    directions[::3] = np.nan
    origins[1::3] = np.inf
    found = Caster(surface).cast_rays(origins, directions)
    assert (found[0][::3] == -1).all() and (found[0][1::3] == -1).all()
    assert np.isinf(found[2][::3]).all()
    clear = Caster(surface).unobstructed(origins, directions, np.zeros(1000, np.float32))
    np.testing.assert_array_equal(clear, np.arange(1000) % 3 == 2)
    for array, reference in zip(found, expected, strict=True):
        np.testing.assert_array_equal(array[2::3], reference[2::3])


@pytest.mark.parametrize("threads", [1, 2])
def test_a_ray_is_unobstructed_up_to_what_it_hits_first(surface, threads):
    origins, directions = random_rays(100_000)
    origins[::7] *= 4
    caster = Caster(surface, threads)
    _, _, distance_mm = caster.cast_rays(origins, directions)
    hit = np.isfinite(distance_mm)
    assert 0.5 < hit.mean() < 1
    reach_mm = np.where(hit, distance_mm, 1e6)
    assert caster.unobstructed(origins, directions, reach_mm * 0.999).all()
    np.testing.assert_array_equal(caster.unobstructed(origins, directions, reach_mm * 1.001), ~hit)


def test_no_rays_and_no_triangles_give_no_hits(surface):
    none = np.zeros((0, 3), np.float32)
    assert [len(array) for array in Caster(surface).cast_rays(none, none)] == [0, 0, 0]
    empty = Surface.from_mesh(np.zeros((3, 3)), np.zeros((0, 3), int), np.zeros((3, 3)))
    assert len(Caster(empty).cast(scenes.pinhole(), np.eye(4))) == 0


@pytest.mark.parametrize("camera", [scenes.pinhole(), scenes.omni()], ids=["pinhole", "omni"])
def test_cast_depth_is_that_of_the_scene(camera):
    surface, scene, T = sphere_surface(), scenes.sphere(), scenes.look((3, 2, -4), (0.2, 0.1, 1))
    hits = Caster(surface).cast(camera, T)
    directions = camera.pixel_directions.reshape(-1, 3)
    expected_mm = scene.distance_mm(T[:3, 3], directions[hits.pixel].astype(np.float64) @ T[:3, :3].T)
    assert len(hits) == np.isfinite(directions).all(axis=1).sum()
    np.testing.assert_allclose(hits.distance_mm, expected_mm, atol=0.05)
    normals = hits.interpolate(surface, surface.normals)
    assert (np.linalg.norm(normals, axis=1) > 0.99).all()


def test_a_mask_lists_only_its_pixels(surface):
    camera, T = scenes.pinhole(), scenes.look((1, 0, 0), (0, 0, 1))
    mask = np.random.default_rng(2).random((camera.height, camera.width)) < 0.3
    whole, part = Caster(surface).cast(camera, T), Caster(surface).cast(camera, T, mask)
    np.testing.assert_array_equal(part.pixel, np.flatnonzero(mask))
    np.testing.assert_array_equal(part.distance_mm, whole.distance_mm[np.flatnonzero(mask)])


def test_hits_are_the_same_far_from_the_origin(surface):
    camera, T = scenes.pinhole(), scenes.look((1, 0, 0), (0, 0, 1))
    far = T.copy()
    far[:3, 3] += 1e6
    near_hits, far_hits = (
        Caster(surface).cast(camera, T),
        Caster(sphere_surface(centre_mm=1e6)).cast(camera, far),
    )
    np.testing.assert_allclose(far_hits.distance_mm, near_hits.distance_mm, atol=1e-4)


@pytest.mark.parametrize("camera", [scenes.pinhole(), scenes.omni()], ids=["pinhole", "omni"])
@pytest.mark.parametrize("scale", [1, 0.37], ids=["whole squares", "parts of squares"])
@pytest.mark.parametrize("moved", [False, True])
def test_a_picture_in_packets_is_that_of_single_rays(surface, camera, scale, moved):
    T, camera = scenes.look((1.13, 0.21, -0.37), (0.031, 0.1, 1)), camera.scaled(scale)
    half = replace(surface, triangles=surface.triangles[::2])
    caster = Caster(half, threads=1)
    if moved:
        caster = caster.moved(swollen(half, 0.2))
    assert caster._packets is not None
    found = caster._picture(camera, T)
    everywhere = np.isfinite(camera.pixel_directions).all(axis=2)
    expected = caster.cast(camera, T, everywhere)
    assert 0.3 < len(found) / everywhere.sum() < 0.7
    np.testing.assert_array_equal(found.pixel, expected.pixel)
    assert (found.triangle != expected.triangle).mean() < 1e-3
    np.testing.assert_allclose(found.distance_mm, expected.distance_mm, rtol=1e-5)
    same = found.triangle == expected.triangle
    np.testing.assert_allclose(found.barycentric[same], expected.barycentric[same], atol=1e-4)


@pytest.mark.parametrize("threads", [1, 2], ids=["packets", "single rays"])
def test_what_is_hidden_behind_a_hit_is_what_a_ray_from_there_meets(surface, threads):
    """Two spheres, one within the other: the inner one hides the outer one, as far as the camera reaches."""
    outer = surface.vertices_mm * 2
    count = len(surface.vertices_mm)
    both = Surface.from_mesh(
        np.concatenate([surface.vertices_mm, outer]),
        np.concatenate([surface.triangles[::2], surface.triangles + count]),
        np.concatenate([surface.normals, surface.normals]),
    )
    caster, camera, T = Caster(both, threads), scenes.pinhole(), np.eye(4)
    hits = caster.cast(camera, T)
    inner = hits.triangle < len(surface.triangles[::2])
    assert 0.3 < inner.mean() < 0.7
    np.testing.assert_array_equal(caster.hides(camera, T, hits, 0.01, 100), inner)
    radius_mm = np.linalg.norm(surface.vertices_mm[0])
    assert not caster.hides(camera, T, hits, 0.01, 1.5 * radius_mm).any()
    assert not caster.hides(camera, T, hits, 1.5 * radius_mm, 100).any()

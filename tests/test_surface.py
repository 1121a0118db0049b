"""A surface keeps its geometry wherever the world's origin is, and on disk."""

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from safetensors.numpy import save_file

from endotwin.surface import Surface
from endotwin.surface.cells import numbered

FAR_MM = np.array([4e6, -7e6, 2e6])


@pytest.fixture
def sphere() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=3, radius=10.0)


def test_float32_vertices_stay_exact_far_from_the_origin(sphere):
    """At 7 km float32 has steps of half a millimetre; about the local origin of a micrometre."""
    world = sphere.vertices + FAR_MM
    surface = Surface.from_mesh(world, sphere.faces, sphere.vertex_normals)
    np.testing.assert_allclose(surface.vertices_mm + surface.origin_mm, world, atol=2e-6)
    assert surface.vertices_mm.dtype == np.float32 and surface.origin_mm.dtype == np.float64


def test_a_pose_made_local_sees_the_local_vertices_as_the_pose_sees_the_world(sphere):
    world = sphere.vertices + FAR_MM
    surface = Surface.from_mesh(world, sphere.faces, sphere.vertex_normals)
    T_world_camera = trimesh.transformations.random_rotation_matrix(np.array([0.2, 0.5, 0.7]))
    T_world_camera[:3, 3] = FAR_MM + np.array([1.0, 2.0, 3.0])
    before = T_world_camera.copy()
    T_local_camera = surface.to_local(T_world_camera)
    np.testing.assert_array_equal(T_world_camera, before)
    in_camera = (world - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
    local = (surface.vertices_mm - T_local_camera[:3, 3]) @ T_local_camera[:3, :3]
    np.testing.assert_allclose(local, in_camera, atol=3e-6)


def test_a_new_surface_is_unseen_and_coverage_changes_nothing_else(sphere):
    surface = Surface.from_mesh(sphere.vertices, sphere.faces, sphere.vertex_normals)
    assert not surface.seen_by.any() and not surface.filled.any()
    assert np.isinf(surface.nearest_mm).all()
    count = len(surface.vertices_mm)
    seen = surface.with_coverage(np.full(count, 3, np.int32), np.ones(count))
    assert (seen.seen_by == 3).all() and not surface.seen_by.any()
    assert seen.vertices_mm is surface.vertices_mm and seen.triangles is surface.triangles


def test_saving_and_loading_is_exact_to_the_bit(sphere, tmp_path):
    generator = np.random.default_rng(0)
    surface = Surface.from_mesh(sphere.vertices + FAR_MM, sphere.faces, sphere.vertex_normals)
    count = len(surface.vertices_mm)
    surface = surface.with_coverage(
        generator.integers(0, 9, count).astype(np.int32),
        np.where(generator.random(count) < 0.5, np.inf, 7.0).astype(np.float32),
    )
    (tmp_path / "surface.safetensors").write_bytes(surface.to_bytes())
    loaded = Surface.load(tmp_path / "surface.safetensors")
    for name, value in vars(surface).items():
        again = getattr(loaded, name)
        assert (again.dtype, again.shape) == (value.dtype, value.shape), name
        assert again.tobytes() == value.tobytes(), name


def test_views_into_larger_arrays_are_saved_as_what_they_show(sphere, tmp_path):
    """safetensors writes raw memory: a strided array must not be written as the memory it lies in."""
    wide = np.repeat(sphere.vertices.astype(np.float32), 2, axis=0)
    surface = Surface.from_mesh(sphere.vertices, sphere.faces, wide[::2])
    strided = np.arange(2 * len(wide[::2]), dtype=np.int32)[::2]
    covered = surface.with_coverage(strided, surface.nearest_mm)
    (tmp_path / "s.safetensors").write_bytes(covered.to_bytes())
    np.testing.assert_array_equal(Surface.load(tmp_path / "s.safetensors").seen_by, strided)


def test_an_array_that_a_surface_no_longer_has_is_passed_over(sphere, tmp_path):
    surface = Surface.from_mesh(sphere.vertices, sphere.faces, sphere.vertices.astype(np.float32))
    older = {**vars(surface), "best_cosine": np.zeros(len(sphere.vertices), np.float32)}
    save_file(older, tmp_path / "surface.safetensors")
    np.testing.assert_array_equal(Surface.load(tmp_path / "surface.safetensors").normals, surface.normals)


def test_a_surface_of_an_older_file_has_no_wall(sphere, tmp_path):
    arrays = vars(Surface.from_mesh(sphere.vertices, sphere.faces, sphere.vertices.astype(np.float32)))
    older = {name: value for name, value in arrays.items() if "wall" not in name}
    save_file(older, tmp_path / "surface.safetensors")
    loaded = Surface.load(tmp_path / "surface.safetensors")
    assert loaded.wall_mm.shape == loaded.wall_triangles.shape == (0, 3)


def test_an_empty_mesh_is_a_surface():
    surface = Surface.from_mesh(np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3)))
    assert repr(surface) == "Surface(0 vertices, 0 triangles)"
    assert np.isfinite(surface.origin_mm).all()


@given(arrays(np.int64, st.tuples(st.integers(0, 40), st.integers(1, 4)), elements=st.integers(-3, 3)))
def test_cells_are_numbered_in_their_order_whatever_lies_in_them(cells):
    number = numbered(cells)
    expected = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1) if len(cells) else number
    np.testing.assert_array_equal(number, expected)
    far = numbered(cells * 2**40)
    np.testing.assert_array_equal(far, number)

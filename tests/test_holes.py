"""Small holes are closed from the surface around them, and never across what rays passed through."""

import numpy as np
import pytest
import trimesh

from endotwin.cameras import Pinhole
from endotwin.fusion.agreement import Tolerance
from endotwin.fusion.holes import filled
from endotwin.fusion.mesh import boundary_edges, surface_of
from endotwin.fusion.views import View

RADIUS_MM, VOXEL_MM = 10.0, 0.2
TOLERANCE = Tolerance(0.3, 0.01)
CAMERA = Pinhole(64, 64, 32.0, 32.0, 31.5, 31.5)


@pytest.fixture(scope="module")
def ball():
    """Vertices and triangles of a sphere about the origin, seen from inside."""
    sphere = trimesh.creation.icosphere(subdivisions=6, radius=RADIUS_MM)
    return np.asarray(sphere.vertices, np.float32), np.asarray(sphere.faces)[:, ::-1]


def torn(ball, hole_mm):
    """The sphere without its triangles within ``hole_mm`` of the +z pole."""
    vertices_mm, triangles = ball
    aside_mm = np.linalg.norm(vertices_mm[triangles].mean(axis=1) - [0, 0, RADIUS_MM], axis=1)
    return surface_of(np.zeros(3), vertices_mm, triangles[aside_mm > hole_mm])


def view(distance_mm):
    """A view from the centre along z that measured one distance everywhere; NaN: nothing."""
    return View(0, np.eye(4), np.full((CAMERA.height, CAMERA.width), distance_mm, np.float32))


def test_a_small_hole_in_a_sphere_is_closed_on_the_sphere_with_its_normals(ball):
    surface = filled(CAMERA, torn(ball, 0.5), [view(np.nan)], TOLERANCE, VOXEL_MM)
    assert len(boundary_edges(surface.triangles)) == 0
    assert surface.filled.any()
    cap_mm, normals = surface.vertices_mm[surface.filled], surface.normals[surface.filled]
    np.testing.assert_allclose(np.linalg.norm(cap_mm, axis=1), RADIUS_MM, atol=0.002)
    inward = -cap_mm / np.linalg.norm(cap_mm, axis=1, keepdims=True)
    assert np.degrees(np.arccos(np.einsum("va,va->v", normals, inward).min())) < 1.5


def test_only_new_vertices_are_marked(ball):
    before = torn(ball, 0.5)
    after = filled(CAMERA, before, [view(np.nan)], TOLERANCE, VOXEL_MM)
    np.testing.assert_array_equal(after.vertices_mm[~after.filled], before.vertices_mm)


def test_what_a_ray_passed_through_stays_open(ball):
    before = torn(ball, 0.5)
    after = filled(CAMERA, before, [view(2 * RADIUS_MM)], TOLERANCE, VOXEL_MM)
    np.testing.assert_array_equal(after.triangles, before.triangles)
    assert not after.filled.any()


def test_a_hole_that_is_no_gap_in_the_sampling_stays_open(ball):
    before = torn(ball, 3.0)
    assert filled(CAMERA, before, [view(np.nan)], TOLERANCE, VOXEL_MM) is before


def test_a_loose_piece_is_not_made_a_bubble(ball):
    vertices_mm, triangles = ball
    aside_mm = np.linalg.norm(vertices_mm[triangles].mean(axis=1) - [0, 0, RADIUS_MM], axis=1)
    piece = surface_of(np.zeros(3), vertices_mm, triangles[aside_mm < 0.5])
    assert filled(CAMERA, piece, [view(np.nan)], TOLERANCE, VOXEL_MM) is piece


def test_of_two_holes_that_touch_both_are_closed(ball):
    vertices_mm, triangles = ball
    tip = triangles[np.argmax(vertices_mm[triangles][..., 2].min(axis=1))][0]
    around = np.flatnonzero((triangles == tip).any(axis=1))
    centre_mm = vertices_mm[triangles[around]].mean(axis=1) - vertices_mm[tip]
    turn = np.argsort(np.arctan2(centre_mm[:, 1], centre_mm[:, 0]))
    opposite = around[turn[[0, len(around) // 2]]]
    surface = surface_of(np.zeros(3), vertices_mm, np.delete(triangles, opposite, axis=0))
    assert len(boundary_edges(surface.triangles)) == 6
    assert len(boundary_edges(filled(CAMERA, surface, [view(np.nan)], TOLERANCE, VOXEL_MM).triangles)) == 0


def test_a_cap_never_folds_over_the_surface_around_it(ball):
    vertices_mm, triangles = ball
    generator = np.random.default_rng(0)
    corners = vertices_mm[triangles]
    torn_out = (corners[..., 2].mean(axis=1) > 0) & (generator.random(len(triangles)) < 0.2)
    before = surface_of(np.zeros(3), vertices_mm, triangles[~torn_out])
    after = filled(CAMERA, before, [view(np.nan)], TOLERANCE, VOXEL_MM)
    a, b, c = after.vertices_mm[after.triangles].transpose(1, 0, 2)
    assert after.filled.any()
    assert (np.einsum("ta,ta->t", np.cross(b - a, c - a), a + b + c) < 0).all()

"""Smoothing of surfaces that noise has crumpled."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from endotwin.fusion.mesh import surface_of, vertex_normals
from endotwin.fusion.smooth import CRUMPLED_DEG, crumple_deg, smoothed

RADIUS_MM = 10.0


@pytest.fixture(scope="module")
def sphere():
    ball = trimesh.creation.icosphere(subdivisions=6, radius=RADIUS_MM)
    return surface_of(np.zeros(3), np.asarray(ball.vertices, np.float32), ball.faces)


def crumpled(surface, noise_mm):
    along = np.random.default_rng(0).normal(0, noise_mm, len(surface.vertices_mm)).astype(np.float32)
    vertices_mm = surface.vertices_mm + along[:, None] * surface.normals
    return replace(surface, vertices_mm=vertices_mm, normals=vertex_normals(vertices_mm, surface.triangles))


def normal_error_deg(surface, true_normals):
    return np.degrees(np.arccos(np.clip(np.einsum("vk,vk->v", surface.normals, true_normals), -1, 1))).mean()


def test_a_smooth_surface_is_returned_as_it_is(sphere):
    assert crumple_deg(sphere) < CRUMPLED_DEG
    assert smoothed(sphere) is sphere


def test_noise_of_a_third_of_an_edge_is_smoothed_to_a_third_of_its_normal_error(sphere):
    noisy = crumpled(sphere, 0.05)
    assert crumple_deg(noisy) > CRUMPLED_DEG
    mended = smoothed(noisy)
    assert normal_error_deg(mended, sphere.normals) < normal_error_deg(noisy, sphere.normals) / 3


def test_smoothing_keeps_the_radius_within_the_noise(sphere):
    mended = smoothed(crumpled(sphere, 0.05))
    radius_mm = np.linalg.norm(mended.vertices_mm, axis=1)
    assert abs(radius_mm.mean() - RADIUS_MM) < 0.005
    assert radius_mm.std() < 0.05 / 2


def test_curvature_is_no_crumple():
    coarse = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS_MM)
    surface = surface_of(np.zeros(3), np.asarray(coarse.vertices, np.float32), coarse.faces)
    bend_deg = np.degrees(np.arccos(surface.normal_agreement().min()))
    assert bend_deg > 4 * CRUMPLED_DEG
    assert smoothed(surface) is surface


def test_a_crumb_that_smoothing_shrinks_to_nothing_is_dropped(sphere):
    noisy = crumpled(sphere, 0.05)
    crumb = np.array([[9, 9, 9], [9.1, 9, 9], [9, 9.1, 9]], np.float32)
    surface = surface_of(
        np.zeros(3),
        np.concatenate([noisy.vertices_mm, crumb]),
        np.concatenate([noisy.triangles, [[len(noisy.vertices_mm) + k for k in range(3)]]]),
    )
    mended = smoothed(surface)
    np.testing.assert_allclose(np.linalg.norm(mended.normals, axis=1), 1, atol=1e-5)
    assert len(mended.triangles) == len(noisy.triangles)

"""Rays to a wall: where they meet it, and what stands in their way."""

import numpy as np

from independent.shapes import diaphragm, sphere
from independent.wall import sampled, unit


def test_hits_lie_on_the_sphere_and_their_normals_point_inside() -> None:
    rng = np.random.default_rng(0)
    wall, start_mm = sphere(10), np.array([1.0, -2, 3])
    hits = wall.cast(start_mm, unit(rng.normal(size=(2000, 3))))
    assert len(hits.rays) == 2000
    outward = hits.points_mm / np.linalg.norm(hits.points_mm, axis=1, keepdims=True)
    np.testing.assert_allclose(np.linalg.norm(hits.points_mm, axis=1), 10, rtol=0.01)
    assert (-(outward * hits.normals).sum(axis=1)).min() > 0.99


def test_a_place_names_its_point() -> None:
    """The wall's own points, looked up at the hits' places, are the hit points."""
    rng = np.random.default_rng(1)
    wall = sphere(10)
    hits = wall.cast(np.zeros(3), unit(rng.normal(size=(500, 3))))
    there_mm = sampled(wall.vertices_mm.reshape(*wall.shape, 3), hits.place)
    assert np.linalg.norm(there_mm - hits.points_mm, axis=1).max() < 0.05


def test_a_ring_throws_the_shadow_that_its_hole_leaves() -> None:
    """Of a point behind a ring, a guide sees it where the line between them passes through the hole."""
    wall, guide_mm = diaphragm(radius_mm=10, hole_mm=4, at_mm=8, length_mm=20), np.array([3.0, 1.0, 0])
    rng = np.random.default_rng(2)
    hits = wall.cast(np.zeros(3), unit(np.c_[rng.uniform(-0.4, 0.4, (4000, 2)), np.ones(4000)]))
    behind = hits.points_mm[:, 2] > 9
    points_mm = hits.points_mm[behind]
    crossing_mm = guide_mm + (8.025 - guide_mm[2]) / (points_mm[:, 2:] - guide_mm[2]) * (points_mm - guide_mm)
    aside_mm = np.linalg.norm(crossing_mm[:, :2], axis=1)
    sure = np.abs(aside_mm - 4) > 0.05
    seen = wall.sees(guide_mm, points_mm)
    assert 0.2 < seen.mean() < 0.9
    np.testing.assert_array_equal(seen[sure], (aside_mm < 4)[sure])

"""What frames see of each other's points: at a glance, and by rays."""

from __future__ import annotations

import numpy as np
import pytest
import tube_twin

from endotwin.surface.casting import Caster, surface_points
from endotwin.surface.vectors import dot, unit
from endotwin.synth.motion import parse_motion
from endotwin.synth.sight import HIDDEN, HIDDEN_MM, Sight, Sights
from endotwin.synth.trajectories import Trajectory
from endotwin.twin import Twin


@pytest.fixture(scope="module")
def folded() -> tuple[Twin, Trajectory]:
    """A tube with folds that hide each other, and poses in it."""
    poses = np.stack([tube_twin.pose(s) for s in (0.2, 0.22, 0.235, 0.26, 0.3)])
    poses[1:, :3, 3] += (0.4, -0.3, 0)
    twin = tube_twin.fitted(tube_twin.seen(tube_twin.surface(fold_mm=4.0)))
    return twin, Trajectory(poses, np.arange(len(poses)) / 30, "poses")


def by_rays(sight: Sight, points: np.ndarray, uv: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Which world points [N, 3] a ray from the camera reaches, and which are in the picture."""
    towards = points - sight.T_world_camera[:3, 3]
    distance_mm = np.sqrt(dot(towards, towards))
    centre = sight.T_world_camera[:3, 3] - sight.surface.origin_mm
    reached = sight.caster.unobstructed(
        np.tile(centre, (len(points), 1)).astype(np.float32),
        unit(towards).astype(np.float32),
        distance_mm * (1 - HIDDEN) - HIDDEN_MM,
    )
    return reached & ((uv > -0.5) & (uv < np.array(size) - 0.5)).all(axis=1)


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("scale", [0.5, 1, 4])
def test_points_are_shown_that_rays_reach(folded, moving, scale):
    twin, trajectory = folded
    camera = twin.camera.scaled(scale)
    motion = parse_motion("peristalsis:amplitude=2", twin) if moving else None
    sights, wrong, points_seen, glances = Sights(twin.surface, motion, trajectory, camera), 0, 0, []
    for one, other in ((0, 1), (1, 0), (2, 3), (4, 2)):
        there = sights[other]
        points = surface_points(there.surface, sights[one].hits)
        towards = there.towards(sights[one].hits)
        np.testing.assert_allclose(towards, points - there.T_world_camera[:3, 3], atol=1e-5)
        uv = there.places(towards)
        in_camera = (points - there.T_world_camera[:3, 3]) @ there.T_world_camera[:3, :3]
        np.testing.assert_allclose(uv, camera.project(in_camera), atol=1e-6 * camera.width, rtol=1e-5)
        expected = by_rays(there, points, uv, (camera.width, camera.height))
        assert 0.02 < (~expected).mean() < 0.9
        wrong += (there.shows(towards, uv) != expected).sum()
        _, known = there._at_a_glance(*uv.T, np.sqrt(dot(towards, towards)))
        glances.append(known[expected].mean())
        points_seen += len(points)
    assert wrong <= 1e-5 * points_seen
    if scale == 4:
        assert np.mean(glances) > 0.6  # else rays were compared with themselves


def test_no_point_behind_the_camera_or_without_a_place_is_shown(folded):
    twin, trajectory = folded
    sight = Sight(Caster(twin.surface), twin.camera, trajectory.T_world_camera[0])
    towards = sight.towards(sight.hits)
    assert sight.shows(towards, sight.places(towards)).mean() > 0.999
    turned = Sight(sight.caster, twin.camera, sight.T_world_camera @ np.diag([-1.0, 1, -1, 1]))
    uv = turned.places(towards)
    assert np.isnan(uv).all() and not turned.shows(towards, uv).any()


def test_sights_of_a_frame_and_its_neighbours_are_kept_and_no_more(folded):
    twin, trajectory = folded
    motion = parse_motion("peristalsis:amplitude=2", twin)
    sights = Sights(twin.surface, motion, trajectory, twin.camera)
    hits = {index: sights[index].hits for index in (0, 1, 2)}
    assert all(sights[index].hits is hits[index] for index in hits)
    sights[3]
    again = sights[0].hits
    assert again is not hits[0]
    np.testing.assert_array_equal(again.triangle, hits[0].triangle)
    np.testing.assert_array_equal(again.distance_mm, hits[0].distance_mm)

"""Trajectories: the centreline against the true axis, jitter within its ranges, and poses outside refused."""

import numpy as np
import pytest
import tube_twin
from scipy.spatial.transform import Rotation

from endotwin.errors import SequenceError, TrajectoryError
from endotwin.poses import write_c3vd_poses
from endotwin.synth import parse_trajectory, synthesize
from endotwin.synth.centerline import find_centerline
from endotwin.synth.lumen import CLEARANCE_MIN_MM, Lumen
from endotwin.synth.trajectories import Trajectory

AXIS_MM = tube_twin.BEND_MM * tube_twin.SWEEP


def off_axis_mm(points):
    return np.linalg.norm(tube_twin.to_axis(points)[1], axis=1)


@pytest.fixture(scope="module")
def tube():
    return tube_twin.fitted(tube_twin.seen(tube_twin.surface()))


@pytest.fixture(scope="module")
def recorded(tube, tmp_path_factory):
    """The tube's twin, with a sequence of five frames to go with it."""
    folder = tmp_path_factory.mktemp("recorded") / "sequence"
    poses = np.stack([tube_twin.pose(s) for s in np.linspace(0.1, 0.7, 5)])
    synthesize(tube, Trajectory(poses, np.arange(5) / 30, "the axis"), folder)
    return tube_twin.fitted(tube.surface, folder), poses


@pytest.mark.parametrize(
    ("fold_mm", "holes"), [(0.0, 0), (3.0, 0), (3.0, 25)], ids=["bare", "folds", "holes"]
)
def test_the_centreline_is_the_axis_of_an_open_tube(fold_mm, holes):
    line = find_centerline(Lumen(tube_twin.surface(fold_mm, holes)))
    off = off_axis_mm(line.points_mm)
    assert off.mean() < 0.3 and off.max() < 1.0
    assert 0.9 * AXIS_MM < line.length_mm < 1.01 * AXIS_MM
    np.testing.assert_allclose(line.radius_mm, tube_twin.RADIUS_MM, atol=2.0)


@pytest.mark.parametrize("towards", [1.0, -1.0])
def test_the_centreline_runs_the_way_the_training_cameras_looked(towards):
    line = find_centerline(Lumen(tube_twin.seen(tube_twin.surface(), towards)))
    s = tube_twin.to_axis(line.points_mm)[0]
    assert np.sign(s[-1] - s[0]) == towards


def test_the_centreline_stays_where_the_wall_was_photographed():
    mesh = tube_twin.seen(tube_twin.surface())
    s = tube_twin.to_axis(mesh.vertices_mm + mesh.origin_mm)[0]
    half = mesh.with_coverage(np.where(s < 0.8, mesh.seen_by, 0), mesh.best_cosine, mesh.nearest_mm)
    on_line = tube_twin.to_axis(find_centerline(Lumen(half)).points_mm)[0]
    assert 0.65 < on_line.max() < 0.82


def test_a_mesh_without_facing_walls_has_no_centreline():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.0]])
    flat = tube_twin.Surface.from_mesh(
        vertices, np.array([[0, 1, 2], [2, 1, 3]]), np.tile([0, 0, 1.0], (4, 1))
    )
    with pytest.raises(TrajectoryError, match="centreline"):
        find_centerline(Lumen(flat))


def test_a_flight_moves_at_its_speed_and_looks_ahead_without_twist(tube):
    trajectory = parse_trajectory("centerline:frames=40,speed=0.75", tube, seed=0)
    rotations, points = trajectory.T_world_camera[:, :3, :3], trajectory.T_world_camera[:, :3, 3]
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (40, 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.norm(np.diff(points, axis=0), axis=1), 0.75, rtol=0.01)
    s = tube_twin.to_axis(points)[0]
    aside = np.degrees(np.arccos(np.einsum("nk,nk->n", tube_twin.axis(s)[1], rotations[:, :, 2])))
    inner = (s > 0.2) & (s < tube_twin.SWEEP - 0.2)
    assert inner.sum() > 5 and aside[inner].max() < 2
    turns = Rotation.from_matrix(rotations[:-1].transpose(0, 2, 1) @ rotations[1:]).as_rotvec()
    assert np.abs(turns[:, 2]).max() < 1e-3 * np.linalg.norm(turns, axis=1).max()
    sagitta_mm = 20**2 / (2 * tube_twin.BEND_MM)  # of the straight approach to the bend
    assert off_axis_mm(points)[inner].max() < 0.5 and off_axis_mm(points).max() < sagitta_mm


def test_a_withdrawal_is_the_flight_backwards(tube):
    forth = parse_trajectory("centerline:speed=2", tube, seed=0)
    back = parse_trajectory("centerline:speed=2,reverse=true", tube, seed=0)
    np.testing.assert_array_equal(back.T_world_camera, forth.T_world_camera[::-1])
    assert np.all(np.diff(back.timestamps_s) > 0)


def test_looking_around_stays_within_its_angle_and_depends_on_the_seed(tube):
    ahead, one, same, other = (
        parse_trajectory(f"centerline:frames=60,look={look}", tube, seed).T_world_camera
        for look, seed in ((0, 1), (15, 1), (15, 1), (15, 2))
    )
    angles = np.degrees(np.arccos(np.clip(np.einsum("nk,nk->n", ahead[:, :3, 2], one[:, :3, 2]), -1, 1)))
    assert 8 < angles.max() <= 15
    np.testing.assert_array_equal(one, same)
    assert not np.allclose(one, other)


def test_a_flight_longer_than_the_line_is_refused_with_what_fits(tube):
    with pytest.raises(TrajectoryError, match=r"at most (\d+) frames") as refused:
        parse_trajectory("centerline:frames=500,speed=1", tube, seed=0)
    fits = int(str(refused.value).split("at most ")[1].split()[0])
    assert len(parse_trajectory(f"centerline:frames={fits},speed=1", tube, seed=0)) == fits


def test_jitter_moves_and_turns_each_pose_within_its_ranges(recorded):
    twin, poses = recorded
    trajectory = parse_trajectory("jitter:frames=100,translation=1.5,rotation=6", twin, seed=4)
    bases = poses[np.arange(100) * 5 // 100]
    moves = np.linalg.norm(trajectory.T_world_camera[:, :3, 3] - bases[:, :3, 3], axis=1)
    relative = bases[:, :3, :3].transpose(0, 2, 1) @ trajectory.T_world_camera[:, :3, :3]
    turns = np.degrees(Rotation.from_matrix(relative).magnitude())
    assert moves.max() <= 1.5 and turns.max() <= 6
    # An even draw from a ball has 7/8 of its points beyond half the radius; an even angle half beyond half.
    assert 0.75 < np.mean(moves > 0.75) < 0.97 and 0.3 < np.mean(turns > 3) < 0.7


def test_jitter_depends_on_the_seed_alone(recorded):
    twin, poses = recorded
    one, same, other = (parse_trajectory("jitter:", twin, seed).T_world_camera for seed in (7, 7, 8))
    assert len(one) == len(poses)
    np.testing.assert_array_equal(one, same)
    assert np.all(np.abs(one - other).max(axis=(1, 2)) > 1e-3)


def test_jitter_draws_again_where_a_pose_would_touch_the_wall(recorded):
    twin, _ = recorded
    trajectory = parse_trajectory("jitter:frames=60,translation=14,rotation=5", twin, seed=0)
    off = off_axis_mm(trajectory.T_world_camera[:, :3, 3])
    assert off.max() < tube_twin.RADIUS_MM - 0.95 * CLEARANCE_MIN_MM
    assert off.max() > 6


def test_jitter_says_that_its_sequence_is_gone(tube):
    with pytest.raises(SequenceError, match="nowhere"):
        parse_trajectory("jitter:frames=3", tube, seed=0)


def test_poses_of_a_file_are_taken_as_they_are(tube, tmp_path):
    poses = np.stack([tube_twin.pose(s) for s in (0.2, 0.5)])
    write_c3vd_poses(tmp_path / "pose.txt", poses)
    trajectory = parse_trajectory(str(tmp_path / "pose.txt"), tube, seed=0)
    np.testing.assert_allclose(trajectory.T_world_camera, poses, rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("move", "fault"),
    [
        ((0, 500.0, 0), "outside the surface"),
        ((0, 14.0, 0), "outside the surface"),
        ((0, 11.7, 0), "from the wall"),
    ],
    ids=["far away", "behind the wall", "at the wall"],
)
def test_a_pose_outside_the_lumen_is_refused_by_its_number_and_file(tube, tmp_path, move, fault):
    poses = np.stack([tube_twin.pose(s) for s in (0.2, 0.4, 0.6)])
    poses[1, :3, 3] += move
    write_c3vd_poses(tmp_path / "path.txt", poses)
    with pytest.raises(TrajectoryError, match=rf"pose 1 of .*path\.txt .*{fault}"):
        parse_trajectory(str(tmp_path / "path.txt"), tube, seed=0)


@pytest.mark.parametrize(
    ("spec", "allowed"),
    [
        ("nowhere.txt", "jitter:frames"),
        ("orbit:frames=3", "centerline:frames"),
        ("jitter:colour=3", "translation"),
        ("jitter:frames=many", "translation"),
        ("jitter:frames=-1", "translation"),
        ("jitter:rotation=nan", "translation"),
        ("jitter:frames", "translation"),
        ("jitter:frames=2,frames=3", "translation"),
        ("centerline:speed=inf", "reverse"),
        ("centerline:reverse=perhaps", "reverse"),
        ("centerline:translation=2", "reverse"),
    ],
)
def test_a_spec_that_is_not_understood_is_refused_with_what_is_allowed(tube, spec, allowed):
    with pytest.raises(TrajectoryError, match=allowed):
        parse_trajectory(spec, tube, seed=0)

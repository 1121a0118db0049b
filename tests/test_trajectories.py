"""Trajectories: the centreline against the true axis, jitter within its ranges, and poses outside refused."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import tube_twin
from scipy.spatial.transform import Rotation

from endotwin import pipeline
from endotwin.errors import OptionError, SequenceError, TrajectoryError
from endotwin.sequence.poses import write_c3vd_poses, write_tum_poses
from endotwin.synth import parse_trajectory, synthesize
from endotwin.synth.trajectories import Trajectory
from endotwin.synth.trajectories.centerline import find_centerline
from endotwin.synth.trajectories.lumen import Lumen
from endotwin.synth.trajectories.screening import Gate, Limits

pytestmark = pytest.mark.slow

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
    half = mesh.with_coverage(np.where(s < 0.8, mesh.seen_by, 0), mesh.nearest_mm)
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


def test_jitter_alone_is_no_path(recorded):
    twin, _ = recorded
    assert not parse_trajectory("jitter:frames=3", twin, 0).successive
    assert parse_trajectory("centerline:frames=3", twin, 0).successive


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
    assert off.max() < tube_twin.RADIUS_MM - 0.95 * Limits().clearance_mm
    assert off.max() > 6


def test_jitter_says_that_its_sequence_is_gone(tube):
    with pytest.raises(SequenceError, match="nowhere"):
        parse_trajectory("jitter:frames=3", tube, seed=0)


def test_poses_of_a_file_are_taken_as_they_are(tube, tmp_path):
    poses = np.stack([tube_twin.pose(s) for s in (0.2, 0.5)])
    write_c3vd_poses(tmp_path / "pose.txt", poses)
    trajectory = parse_trajectory(str(tmp_path / "pose.txt"), tube, seed=0)
    np.testing.assert_allclose(trajectory.T_world_camera, poses, rtol=0, atol=1e-14)


@pytest.mark.parametrize(("unit", "warns"), [(1.0, False), (1e-3, True), (0.0, False)])
def test_a_path_in_metres_gives_a_warning_and_one_that_only_turns_none(tube, tmp_path, caplog, unit, warns):
    poses = np.stack([tube_twin.pose(s) for s in (0.4, 0.6)])
    poses[:, :3, 3] = poses[0, :3, 3] * (1 - unit) + poses[:, :3, 3] * unit
    write_c3vd_poses(tmp_path / "path.txt", poses)
    parse_trajectory(str(tmp_path / "path.txt"), tube, seed=0)
    assert ("if they are in metres" in caplog.text) == warns


@pytest.mark.parametrize(
    ("move", "fault"),
    [
        ((0, 500.0, 0), "outside the surface"),
        ((0, 14.0, 0), "outside the surface"),
    ],
    ids=["far away", "behind the wall"],
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
        ("ring:frames=3", "orbit:x=…,y=…"),
        ("orbit:frames=3", "give x, y and z"),
        ("orbit:u=3,v=3,radius=-1", "radius .*distance from the point"),
        ("orbit:x=0,y=0,z=50,frames=0", "an orbit of 0 frames"),
        ("orbit:x=0,y=0,z=50,frame=0,u=3,v=3", "two points"),
        ("centerline:speed=0.00001", "raise its speed"),
        ("spline:", "no file"),
        ("jitter:colour=3", "translation"),
        ("jitter:frames=many", "number of poses"),
        ("jitter:frames=-1", "between 0 and"),
        ("jitter:frames=10000000", "between 0 and 100000"),
        ("jitter:rotation=nan", "largest turn, degrees"),
        ("jitter:frames", "translation"),
        ("jitter:frames=2,frames=3", "translation"),
        ("centerline:speed=inf", "mm a frame"),
        ("centerline:reverse=perhaps", "is true or false"),
        ("centerline:translation=2", "reverse"),
    ],
)
def test_a_spec_that_is_not_understood_is_refused_with_what_is_allowed(tube, spec, allowed):
    with pytest.raises(TrajectoryError, match=allowed):
        parse_trajectory(spec, tube, seed=0)


@pytest.mark.parametrize("times_s", [(0, 0, 0), (1, 2, 2), (3, 2, 1), (0, 1e-7, 2e-7)])
def test_times_that_do_not_rise_are_told_and_not_taken(tube, tmp_path, caplog, times_s):
    poses = np.stack([tube_twin.pose(s) for s in (0.2, 0.4, 0.6)])
    write_tum_poses(tmp_path / "path.txt", poses, np.array(times_s, float))
    trajectory = parse_trajectory(str(tmp_path / "path.txt"), tube, seed=0)
    np.testing.assert_allclose(trajectory.timestamps_s * 30, [0, 1, 2])
    assert "do not rise" in caplog.text


def test_poses_of_a_file_that_break_a_limit_are_dropped_counted_and_keep_their_times(
    recorded, tmp_path, caplog
):
    twin, _ = recorded
    poses = np.stack([tube_twin.pose(s) for s in (0.2, 0.4, 0.6, 0.7)])
    poses[1, :3, 3] += (0, 11.7, 0)
    write_c3vd_poses(tmp_path / "path.txt", poses)
    trajectory = parse_trajectory(str(tmp_path / "path.txt"), twin, seed=0)
    np.testing.assert_array_equal(trajectory.numbers, [0, 2, 3])
    np.testing.assert_allclose(trajectory.timestamps_s * 30, [0, 2, 3])
    assert trajectory.counts == {"asked": 4, "redrawn": 0, "dropped": 1}
    assert "pose 1" in caplog.text and "from the wall" in caplog.text
    assert parse_trajectory(str(tmp_path / "path.txt"), twin, 0, limits=Limits(clearance_mm=0.1)).counts == {
        "asked": 4,
        "redrawn": 0,
        "dropped": 0,
    }


def test_the_gate_measures_clearance_unseen_surface_and_distance_from_the_training_views(recorded):
    twin, recorded_poses = recorded
    s = tube_twin.to_axis(twin.surface.vertices_mm + twin.surface.origin_mm)[0]
    surface = replace(twin.surface, seen_by=np.where(s < 0.5, 5, 0).astype(np.int32), filled=s > 0.9)
    half = replace(twin, surface=surface)
    poses = np.stack([tube_twin.pose(s) for s in (0.1, 0.45, 0.8)])
    poses[0, 1, 3] += 4.0
    findings = Gate(half, half.camera, Limits(unknown=1.0)).judge(poses)
    assert findings.outlook.clearance_mm[0] == pytest.approx(tube_twin.RADIUS_MM - 4, abs=0.1)
    known = 1 - findings.outlook.unseen - findings.outlook.filled
    assert known[0] > 0.55 > known[1] > 0.03 and known[2] < 0.2 and findings.outlook.filled[2] > 0.3
    training = recorded_poses[twin.source.training(5), :3, 3]
    nearest_mm = np.linalg.norm(poses[:, None, :3, 3] - training, axis=2).min(axis=1)
    np.testing.assert_allclose(findings.training_mm, nearest_mm)
    strict = Gate(half, half.camera, Limits(unknown=0.45, training_mm=10)).judge(poses)
    np.testing.assert_array_equal(strict.passes, [True, False, False])


def test_a_limit_that_no_pose_keeps_is_an_error_that_says_why(recorded):
    with pytest.raises(TrajectoryError, match=r"none of its 5 poses .* training view \(most: 0.01 mm\)"):
        parse_trajectory("jitter:", recorded[0], 0, limits=Limits(training_mm=0.01))


@pytest.mark.parametrize("limits", [{"clearance_mm": -1}, {"unknown": 1.5}, {"training_mm": np.nan}])
def test_limits_that_make_no_sense_are_refused(limits):
    with pytest.raises(OptionError):
        Limits(**limits)


def test_random_poses_keep_the_limits_and_redraws_are_counted(recorded):
    twin, poses = recorded
    near = Limits(training_mm=3.0, clearance_mm=2.0)
    trajectory = parse_trajectory("jitter:frames=40,translation=8", twin, 0, limits=near)
    away = np.linalg.norm(trajectory.T_world_camera[:, None, :3, 3] - poses[1:, :3, 3], axis=2).min(axis=1)
    assert away.max() <= 3.0 and trajectory.checks["clearance_mm"].min() >= 2.0
    assert trajectory.counts["redrawn"] > 10


def test_a_spline_passes_through_its_keyframes_smoothly_and_evenly(tube, tmp_path):
    keyframes = np.stack([tube_twin.pose(s) for s in (0.2, 0.35, 0.6, 0.8)])
    keyframes[:, :3, 3] += np.random.default_rng(1).uniform(-2, 2, (4, 3))
    write_c3vd_poses(tmp_path / "keys.txt", keyframes)
    poses = parse_trajectory(f"spline:{tmp_path / 'keys.txt'},frames=400", tube, seed=0).T_world_camera
    for keyframe in keyframes:
        off_mm = np.linalg.norm(poses[:, :3, 3] - keyframe[:3, 3], axis=1)
        turned = Rotation.from_matrix(keyframe[:3, :3].T @ poses[off_mm.argmin(), :3, :3]).magnitude()
        assert off_mm.min() < 0.1 and np.degrees(turned) < 0.5
    np.testing.assert_allclose(poses[[0, -1]], keyframes[[0, -1]], atol=1e-9)
    steps_mm = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turns = Rotation.from_matrix(poses[:-1, :3, :3].swapaxes(1, 2) @ poses[1:, :3, :3]).magnitude()
    np.testing.assert_allclose(np.hypot(steps_mm, 5 * turns), np.hypot(steps_mm, 5 * turns).mean(), rtol=0.02)
    assert np.abs(np.diff(steps_mm)).max() < 0.02 * steps_mm.mean()


def test_a_spline_at_a_speed_advances_by_it_and_needs_two_keyframes(tube, tmp_path):
    write_c3vd_poses(tmp_path / "keys.txt", np.stack([tube_twin.pose(s) for s in (0.2, 0.2, 0.7)]))
    poses = parse_trajectory(f"spline:{tmp_path / 'keys.txt'},speed=0.5", tube, seed=0).T_world_camera
    steps_mm = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert 0.45 < steps_mm.max() <= 0.5001
    write_c3vd_poses(tmp_path / "one.txt", np.stack([tube_twin.pose(0.2)] * 2))
    with pytest.raises(TrajectoryError, match=r"one\.txt has fewer than two"):
        parse_trajectory(f"spline:{tmp_path / 'one.txt'}", tube, seed=0)


def test_an_orbit_looks_at_its_point_from_its_radius_and_tilt(tube):
    point = tube_twin.axis(np.array(0.7))[0] + (0, tube_twin.RADIUS_MM, 0)
    spec = f"orbit:x={point[0]},y={point[1]},z={point[2]},radius=9,tilt=35,frames=24"
    trajectory = parse_trajectory(spec, tube, seed=0)
    poses = trajectory.T_world_camera
    assert len(poses) == 24
    towards = point - poses[:, :3, 3]
    np.testing.assert_allclose(np.linalg.norm(towards, axis=1), 9, rtol=1e-6)
    np.testing.assert_allclose(poses[:, :3, 2], towards / 9, atol=1e-6)
    tilt = np.degrees(np.arccos(towards @ np.array([0, 1.0, 0]) / 9))
    np.testing.assert_allclose(tilt, 35, atol=1.0)


def test_an_orbit_takes_its_point_from_a_pixel_of_a_frame(recorded):
    twin, poses = recorded
    trajectory = parse_trajectory("orbit:frame=1,u=20,v=60,radius=6,frames=8", twin, seed=0)
    ray = twin.camera.directions(np.array([20.0, 60.0])) @ poses[1, :3, :3].T
    point = trajectory.T_world_camera[0, :3, 3] + 6 * trajectory.T_world_camera[0, :3, 2]
    away = point - poses[1, :3, 3]
    np.testing.assert_allclose(away / np.linalg.norm(away), ray, atol=1e-3)
    assert off_axis_mm(point[None])[0] == pytest.approx(tube_twin.RADIUS_MM, abs=0.05)
    with pytest.raises(TrajectoryError, match="no frame 9"):
        parse_trajectory("orbit:frame=9,u=20,v=60", twin, seed=0)


def test_frames_tell_their_checks_and_their_number_in_the_trajectory(recorded, tmp_path):
    twin, _ = recorded
    trajectory = parse_trajectory("jitter:frames=6", twin, seed=2)
    synthesize(twin, trajectory, tmp_path / "d", labels=("depth",))
    records = [json.loads(line) for line in (tmp_path / "d" / "frames.jsonl").read_text().splitlines()]
    assert [record["pose"] for record in records] == list(range(6))
    assert {"clearance_mm", "unseen", "filled", "empty", "training_mm"} == set(records[0]["checks"])
    document = json.loads((tmp_path / "d" / "dataset.json").read_text())
    assert document["limits"] == {"clearance_mm": 1.0, "unknown": 0.5, "training_mm": None}
    assert document["poses"]["asked"] == 6 and document["command"]["trajectory"] == "jitter:frames=6"


def test_a_preview_shows_the_poses_and_what_they_see(recorded, tmp_path):
    twin, _ = recorded
    line = pipeline.preview(twin, "centerline:frames=30", tmp_path / "look.png", light=["intensity*0.5"])
    picture = cv2.imread(str(tmp_path / "look.png"))
    assert "30 poses" in line and picture.shape[1] == 4 * twin.camera.width
    rows = 3 * twin.camera.height
    mesh, sheet = picture[:-rows], picture[-rows:]
    assert mesh.std() > 5 and sheet.std() > 10
    assert list(tmp_path.iterdir()) == [tmp_path / "look.png"]

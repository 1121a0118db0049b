"""The camera's way between two poses, and that both exposure effects work at once."""

import numpy as np
import plane
import pytest
from scipy.spatial.transform import Rotation, Slerp

from endotwin.effects.exposure import MAX_POSES, Shot, expose, following
from endotwin.effects.motion_blur import MotionBlur
from endotwin.effects.rolling_shutter import RollingShutter


def turned(rotation_vector: np.ndarray, position_mm: np.ndarray) -> np.ndarray:
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = Rotation.from_rotvec(rotation_vector).as_matrix()
    T_world_camera[:3, 3] = position_mm
    return T_world_camera


def shot(T_world_next: np.ndarray, **timing) -> Shot:
    return Shot(plane.CAMERA, np.eye(4), T_world_next, plane.depth(), **timing)


def test_the_way_between_two_poses_turns_as_slerp_does_and_meets_both():
    here, there = turned([0.2, -0.1, 0.3], [1, 2, 3]), turned([-0.3, 0.4, 0.1], [2, 0, 5])
    way = Shot(plane.CAMERA, here, there, plane.depth())
    times = np.linspace(0, 1, 6)
    slerp = Slerp([0, 1], Rotation.from_matrix([here[:3, :3], there[:3, :3]]))(times)
    for time, rotation in zip(times, slerp.as_matrix(), strict=True):
        np.testing.assert_allclose(way.pose(time)[:3, :3], rotation, atol=1e-12)
    np.testing.assert_allclose(way.pose(1), there, atol=1e-12)
    assert way.pose(0) is here


def test_the_way_is_one_screw_so_equal_steps_are_equal_motions():
    way = Shot(
        plane.CAMERA, turned([0.2, 0, 0.3], [1, 2, 3]), turned([0, 0.4, 0.1], [2, 0, 5]), plane.depth()
    )
    steps = [np.linalg.inv(way.pose(t)) @ way.pose(t + 0.25) for t in (-0.5, 0.0, 0.4)]
    np.testing.assert_allclose(steps[0], steps[1], atol=1e-12)
    np.testing.assert_allclose(steps[0], steps[2], atol=1e-12)


@pytest.mark.parametrize("mm", [0.3, -2.0])
def test_the_speed_of_a_wall_is_f_times_motion_over_depth(mm):
    assert shot(plane.moved(x_mm=mm)).speed_px == pytest.approx(abs(plane.px(mm)), rel=1e-6)


def test_the_speed_under_a_turn_about_the_axis_is_that_of_the_outer_pixels():
    T_world_next = turned([0, 0, 0.02], [0, 0, 0])
    corner = np.hypot(59.5, 39.5)
    assert 0.8 * 0.02 * corner < shot(T_world_next).speed_px < 0.02 * corner


def test_a_camera_that_is_still_costs_one_frame_and_changes_nothing():
    wall = plane.Plane(lambda x, y: np.sin(x) + y)
    effects = [MotionBlur(1.0), RollingShutter(1.0)]
    exposed = expose(wall.film, shot(np.eye(4)), effects)
    assert len(wall.poses) == 1
    assert np.array_equal(exposed, wall.film(np.eye(4), None))


def test_no_surface_and_motion_too_small_to_see_cost_one_frame():
    wall = plane.Plane(lambda x, y: np.sin(x) + y)
    nothing = Shot(plane.CAMERA, np.eye(4), plane.moved(5), np.full_like(plane.depth(), np.nan))
    for still in (nothing, shot(plane.moved(0.01))):
        wall.poses.clear()
        assert expose(wall.film, still, [MotionBlur(1.0), RollingShutter(1.0)]).isfinite().all()
        assert len(wall.poses) == 1


def test_motion_across_the_whole_image_costs_no_more_than_the_bound():
    wall = plane.Plane(lambda x, y: x)
    MotionBlur(1.0).expose(wall.film, shot(plane.moved(200)))
    assert len(wall.poses) == MAX_POSES


@pytest.mark.parametrize(("shutter", "readout"), [(0.3, 0.8), (0.05, 1.0), (1.0, 0.1), (0.5, 0.5)])
def test_each_row_is_blurred_about_its_own_time(shutter, readout):
    """A wave along x under sideways motion: its phase tells each row's time, its amplitude the exposure's."""
    mm, wave = 4.0, 0.7
    wall = plane.Plane(lambda x, y: np.exp(1j * wave * x).real)
    both = [RollingShutter(readout), MotionBlur(shutter)]
    exposed = expose(wall.film, shot(plane.moved(mm)), both)[..., 0].numpy()
    rows, columns = plane.CAMERA.height, plane.CAMERA.width
    time = readout * ((np.arange(rows)[:, None] + 0.5) / rows - 0.5)
    x_mm = (np.arange(columns) - 59.5) * plane.DEPTH_MM / plane.CAMERA.fx
    amplitude = np.sinc(wave * mm * shutter / (2 * np.pi))
    exact = amplitude * np.cos(wave * (x_mm + mm * time))
    half_step_mm = 0.5 * plane.DEPTH_MM / plane.CAMERA.fx
    assert np.abs(exposed - exact).max() < wave * half_step_mm * amplitude + 0.01


def test_the_pose_one_frame_later_is_the_next_one_and_the_last_goes_on():
    trajectory = np.stack([turned([0, 0, 0.1 * k], [k, 0, 0]) for k in range(4)])
    later = following(trajectory)
    assert np.array_equal(later[:-1], trajectory[1:])
    np.testing.assert_allclose(
        np.linalg.inv(trajectory[3]) @ later[3], np.linalg.inv(trajectory[2]) @ trajectory[3], atol=1e-12
    )
    assert np.array_equal(following(trajectory[:1]), trajectory[:1])


@pytest.mark.parametrize("numbers", [(0, 1, 2, 6, 7), (0, 3, 6, 7), (0, 7)])
def test_where_poses_are_missing_the_camera_goes_no_faster(numbers):
    even = np.stack([turned([0, 0, 0.1 * k], [k, 0, 0]) for k in range(8)])
    step = np.linalg.inv(even[0]) @ even[1]
    path = np.stack([np.linalg.matrix_power(step, k) for k in numbers])
    later = following(path, np.array(numbers))
    for pose, next_pose in zip(path, later, strict=True):
        np.testing.assert_allclose(pose @ step, next_pose, atol=1e-9)

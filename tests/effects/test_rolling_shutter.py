"""Rolling shutter against the shear that sideways motion makes of a wall."""

import numpy as np
import plane
import pytest

from endotwin.effects.exposure import STRIP_PX, Shot
from endotwin.effects.rolling_shutter import RollingShutter


def read_out(wall: plane.Plane, T_world_next: np.ndarray, readout: float) -> np.ndarray:
    shot = Shot(plane.CAMERA, np.eye(4), T_world_next, plane.depth())
    return RollingShutter(readout).expose(wall.film, shot)[..., 0].numpy()


def row_times(readout: float) -> np.ndarray:
    return readout * ((np.arange(plane.CAMERA.height) + 0.5) / plane.CAMERA.height - 0.5)


@pytest.mark.parametrize("readout", [0.2, 0.8, 1.0])
@pytest.mark.parametrize("mm", [1.0, -6.0])
def test_sideways_motion_shears_the_wall_by_row(mm, readout):
    wall = plane.Plane(lambda x, y: x)
    shift_mm = (read_out(wall, plane.moved(mm), readout) - wall.film(np.eye(4), None)[..., 0].numpy()).mean(
        axis=1
    )
    error_px = plane.px(1.0) * np.abs(shift_mm - mm * row_times(readout))
    assert error_px.max() <= STRIP_PX / 2 + 1e-3


def test_upward_motion_stretches_the_wall():
    wall = plane.Plane(lambda x, y: y)
    found = read_out(wall, plane.moved(y_mm=2.0), 1.0).mean(axis=1)
    exact = (np.arange(plane.CAMERA.height) - 39.5) * plane.DEPTH_MM / plane.CAMERA.fx + 2.0 * row_times(1.0)
    assert plane.px(1.0) * np.abs(found - exact).max() <= STRIP_PX / 2 + 1e-3


def test_each_pixel_is_rendered_once():
    wall = plane.Plane(lambda x, y: x)
    found = read_out(wall, plane.moved(5.0), 1.0)
    assert wall.pixels == plane.CAMERA.width * plane.CAMERA.height
    assert np.isfinite(found).all()
    assert len(wall.poses) > 40


def test_the_middle_row_is_at_the_labelled_pose():
    wall = plane.Plane(lambda x, y: x)
    found = read_out(wall, plane.moved(3.0), 1.0)[39:41].mean(axis=0)
    exact = wall.film(np.eye(4), None)[39:41, :, 0].numpy().mean(axis=0)
    assert plane.px(1.0) * np.abs(found - exact).max() < STRIP_PX

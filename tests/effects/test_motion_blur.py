"""Motion blur against the box filter that sideways motion before a wall is."""

import numpy as np
import plane
import pytest
from scipy.ndimage import uniform_filter1d

from endotwin.effects.exposure import Shot
from endotwin.effects.motion_blur import MotionBlur


def blurred(wall: plane.Plane, T_world_next: np.ndarray, shutter: float) -> np.ndarray:
    shot = Shot(plane.CAMERA, np.eye(4), T_world_next, plane.depth())
    return MotionBlur(shutter).expose(wall.film, shot)[..., 0].numpy()


@pytest.mark.parametrize("direction", ["x_mm", "y_mm"])
@pytest.mark.parametrize("blur_px", [0.6, 3.0, 7.5, 14.0])
def test_a_wave_loses_the_sinc_of_its_length(direction, blur_px):
    wave = 0.9
    wall = plane.Plane(lambda x, y: np.cos(wave * (x if direction == "x_mm" else y)))
    mm, shutter = 2 * blur_px * plane.DEPTH_MM / plane.CAMERA.fx, 0.5
    sharp = wall.film(np.eye(4), None)[..., 0].numpy()
    exact = np.sinc(wave * mm * shutter / (2 * np.pi)) * sharp
    assert np.abs(blurred(wall, plane.moved(**{direction: mm}), shutter) - exact).max() < 0.005


def test_a_motion_of_whole_pixels_is_a_box_filter_of_the_photo():
    image = np.random.default_rng(0).uniform(0, 1, (80, 400))
    image = uniform_filter1d(image, 5, axis=1)

    def radiance(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        u, v = x * 5 + 199.5, np.rint(y * 5 + 39.5).astype(int)
        left = np.floor(u).astype(int)
        return image[v, left] * (left + 1 - u) + image[v, left + 1] * (u - left)

    wall = plane.Plane(radiance)
    sharp = wall.film(np.eye(4), None)[..., 0].numpy()
    box = np.convolve(np.ones(8), [0.5, 0.5]) / 8
    exact = np.stack([np.convolve(row, box, mode="same") for row in sharp])
    found = blurred(wall, plane.moved(8 * plane.DEPTH_MM / plane.CAMERA.fx), 1.0)
    assert np.abs(found - exact)[:, 8:-8].max() < 0.01


def test_it_costs_about_a_frame_a_pixel_of_motion():
    wall = plane.Plane(lambda x, y: x)
    blurred(wall, plane.moved(plane.DEPTH_MM * 10 / plane.CAMERA.fx), 0.7)
    assert 7 <= len(wall.poses) <= 9


def test_radiance_is_averaged_and_none_is_lost():
    wall = plane.Plane(lambda x, y: 100 * np.exp(-((x / 0.3) ** 2)))
    found = blurred(wall, plane.moved(1.2), 1.0)
    sharp = wall.film(np.eye(4), None)[..., 0].numpy()
    assert found.sum() == pytest.approx(sharp.sum(), rel=1e-3)
    assert found.max() < 0.5 * sharp.max()


def test_the_blur_is_centred_on_the_labelled_pose():
    wall = plane.Plane(lambda x, y: x)
    found = blurred(wall, plane.moved(3.0), 1.0)
    np.testing.assert_allclose(found, wall.film(np.eye(4), None)[..., 0], atol=1e-5)

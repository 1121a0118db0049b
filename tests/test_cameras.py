"""Camera models: round trips, agreement with OpenCV, scaling, and descriptions that cannot be used."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from endotwin.cameras import CALIBRATIONS, Fisheye, Pinhole, camera_from_dict, read_camera
from endotwin.errors import CameraError, OptionError

PLAIN = Pinhole(640, 480, 384.0, 390.0, 319.5, 238.0)
BROWN = Pinhole(640, 480, 384.0, 390.0, 322.0, 238.0, k1=-0.12, k2=0.03, p1=1e-3, p2=-2e-3, k3=-0.002)
RATIONAL = Pinhole(640, 480, 384.0, 390.0, 322.0, 238.0, k1=8.0, k2=4.0, k3=0.2, k4=8.3, k5=6.0, k6=1.0)
FISHEYE = Fisheye(640, 480, 210.0, 212.0, 318.0, 243.0, k1=0.03, k2=-0.01, k3=0.002, k4=-2e-4)
OMNIS = list(CALIBRATIONS.values())
ALL = [PLAIN, BROWN, RATIONAL, FISHEYE, *OMNIS]
fraction = st.floats(0, 1)


def grid(camera, steps=40):
    """Pixel coordinates [steps, steps, 2] over the whole image, corners included."""
    u, v = np.linspace(-0.5, camera.width - 0.5, steps), np.linspace(-0.5, camera.height - 0.5, steps)
    return np.stack(np.meshgrid(u, v), axis=-1)


def name(camera):
    return f"{camera.model}-{camera.width}-{camera.to_dict().get('k1', camera.to_dict().get('a2'))}"


@pytest.mark.parametrize("camera", ALL, ids=name)
@settings(max_examples=60, deadline=None)
@given(at=st.tuples(fraction, fraction), distance=st.floats(1e-2, 1e4))
def test_every_pixel_of_the_image_projects_back_to_itself_from_any_distance(camera, at, distance):
    uv = np.array(at) * (camera.width, camera.height) - 0.5
    ray = camera.directions(uv)
    assert np.linalg.norm(ray) == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose(camera.project(ray * distance), uv, atol=1e-8)


def test_c3vd_corners_look_backwards_and_still_project():
    camera = CALIBRATIONS["c3vd-v1"]
    corner = np.array([0.0, 0.0])
    ray = camera.directions(corner)
    assert ray[2] < 0
    np.testing.assert_allclose(camera.project(ray * 30), corner, atol=1e-9)


def test_omni_rays_follow_scaramuzzas_formula():
    camera = CALIBRATIONS["c3vd-v1"]
    u, v = 900.0, 100.0
    x, y = np.linalg.solve([[camera.c, camera.d], [camera.e, 1]], [u - camera.cx, v - camera.cy])
    rho2 = x * x + y * y
    z = camera.a0 + camera.a2 * rho2 + camera.a3 * rho2**1.5 + camera.a4 * rho2**2
    np.testing.assert_allclose(
        camera.directions(np.array([u, v])), np.array([x, y, z]) / np.hypot(rho2**0.5, z)
    )


def test_a_pixel_right_of_the_centre_looks_right_and_one_below_looks_down():
    for camera in ALL:
        centre = np.array([camera.width / 2, camera.height / 2])
        assert camera.directions(centre + np.array([100, 0]))[0] > 0.05
        assert camera.directions(centre + np.array([0, 100]))[1] > 0.05


@pytest.mark.parametrize("camera", [PLAIN, BROWN, RATIONAL], ids=name)
def test_pinhole_projects_as_opencv_does(camera):
    points = (
        np.random.default_rng(0).uniform((-0.7, -0.5, 1), (0.7, 0.5, 1), (500, 3))
        * np.linspace(1, 90, 500)[:, None]
    )
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)[0][:, 0]
    np.testing.assert_allclose(camera.project(points), expected, atol=1e-9)


def test_fisheye_projects_as_opencv_does():
    points = np.random.default_rng(0).uniform((-2, -2, 1), (2, 2, 1), (500, 3))
    K = np.array([[FISHEYE.fx, 0, FISHEYE.cx], [0, FISHEYE.fy, FISHEYE.cy], [0, 0, 1]])
    D = np.array([FISHEYE.k1, FISHEYE.k2, FISHEYE.k3, FISHEYE.k4])
    expected = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), K, D)[0][:, 0]
    np.testing.assert_allclose(FISHEYE.project(points), expected, atol=1e-9)


def test_fisheye_sees_more_than_180_degrees():
    wide = Fisheye(400, 400, 100.0, 100.0, 199.5, 199.5)
    ray = wide.directions(np.array([199.5 + 100 * np.radians(110), 199.5]))
    np.testing.assert_allclose(ray, [np.sin(np.radians(110)), 0, np.cos(np.radians(110))], atol=1e-12)
    np.testing.assert_allclose(wide.project(ray), [199.5 + 100 * np.radians(110), 199.5])


@pytest.mark.parametrize("camera", ALL, ids=name)
@pytest.mark.parametrize("scale", [0.5, 0.37, 1.7])
def test_a_scaled_camera_sees_the_same_rays(camera, scale):
    scaled = camera.scaled(scale)
    assert (scaled.width, scaled.height) == (round(camera.width * scale), round(camera.height * scale))
    uv = grid(camera)
    ratio = np.array([scaled.width / camera.width, scaled.height / camera.height])
    np.testing.assert_allclose(scaled.directions((uv + 0.5) * ratio - 0.5), camera.directions(uv), atol=1e-8)


@pytest.mark.parametrize("camera", ALL, ids=name)
def test_a_lengthened_camera_shows_the_same_larger_about_its_centre(camera):
    points, centre = camera.directions(grid(camera)), np.array([camera.cx, camera.cy])
    shown = camera.lengthened(1.02).project(points)
    np.testing.assert_allclose(shown - centre, 1.02 * (camera.project(points) - centre), atol=1e-6)


def test_a_pinhole_sees_nothing_behind_it():
    assert np.isnan(PLAIN.project(np.array([[0.1, 0.2, -1.0], [0.1, 0.2, 0.0]]))).all()


def test_points_beyond_the_range_of_a_distortion_are_not_folded_back_into_the_image():
    barrel = Pinhole(640, 480, 384.0, 384.0, 319.5, 239.5, k1=-0.3)
    turning = 1 / np.sqrt(0.9)  # where d(r − 0.3 r³)/dr = 0
    inside, outside = barrel.project(np.array([[0.99 * turning, 0, 1], [1.01 * turning, 0, 1]]))
    assert np.isfinite(inside).all()
    assert np.isnan(outside).all()
    assert np.isnan(barrel.directions(np.array([0.0, 0.0]))).all()
    np.testing.assert_allclose(barrel.project(barrel.directions(inside)), inside, atol=1e-8)


def test_the_direction_straight_ahead_is_exact_and_straight_behind_is_nowhere():
    for camera in (FISHEYE, *OMNIS):
        np.testing.assert_allclose(camera.project(np.array([0, 0, 5.0])), (camera.cx, camera.cy), atol=1e-9)
        assert np.isnan(camera.project(np.array([0, 0, -5.0]))).all()


@pytest.mark.parametrize("camera", ALL, ids=name)
def test_a_camera_survives_its_own_json(camera, tmp_path):
    (tmp_path / "camera.json").write_text(json.dumps(camera.to_dict()))
    assert read_camera(tmp_path / "camera.json") == camera


@pytest.mark.parametrize("camera", ALL, ids=name)
def test_pixel_directions_are_the_directions_of_pixel_centres(camera):
    small = camera.scaled(0.05)
    assert small.pixel_directions.shape == (small.height, small.width, 3)
    np.testing.assert_allclose(small.pixel_directions[2, 5], small.directions(np.array([5, 2])), atol=1e-6)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"model": "thin_prism"}, "pinhole, fisheye, omni"),
        ({"model": None}, "unknown"),
        ({"fx": -3}, "'fx'"),
        ({"fx": "384"}, "'fx'"),
        ({"cy": float("nan")}, "'cy'"),
        ({"width": 640.5}, "'width'"),
        ({"height": 0}, "'height'"),
        ({"focal": 3}, "'focal'"),
    ],
)
def test_a_camera_that_makes_no_sense_is_refused_by_file_and_key(change, told):
    with pytest.raises(CameraError) as caught:
        camera_from_dict({**PLAIN.to_dict(), **change}, Path("there/camera.json"))
    assert "there/camera.json" in str(caught.value)
    assert told in str(caught.value)


def test_a_missing_key_is_named():
    description = PLAIN.to_dict()
    del description["cx"]
    with pytest.raises(CameraError, match=r"camera\.json.*'cx' is missing"):
        camera_from_dict(description, Path("camera.json"))


def test_a_broken_camera_json_is_refused_by_name(tmp_path):
    (tmp_path / "camera.json").write_text('{"model": ')
    with pytest.raises(CameraError, match=r"camera\.json cannot be read as JSON"):
        read_camera(tmp_path / "camera.json")


def test_a_camera_json_that_is_not_there_is_told_so(tmp_path):
    with pytest.raises(CameraError, match=r"nowhere\.json cannot be read \(No such file or directory\)"):
        read_camera(tmp_path / "nowhere.json")


@pytest.mark.parametrize(
    ("parameters", "told"),
    [
        ({"fx": 1e-6, "fy": 1e-6}, "90° away from the axis"),
        ({"fx": 1e8, "fy": 1e8}, "in pixels"),
        ({"cx": 1e7}, "in pixels"),
        ({"k1": -50.0}, "check its distortion"),
    ],
)
def test_a_camera_that_sees_nothing_of_use_is_refused(parameters, told):
    with pytest.raises(CameraError, match=rf"camera\.json: .*{told}"):
        camera_from_dict({**PLAIN.to_dict(), **parameters}, Path("camera.json"))


def test_the_calibrations_see_enough_to_be_read_back():
    for camera in CALIBRATIONS.values():
        assert camera_from_dict(camera.to_dict(), Path("camera.json")) == camera


@pytest.mark.parametrize("scale", [0, -1, float("nan"), 1e-5])
def test_a_scale_that_leaves_no_image_is_refused(scale):
    with pytest.raises(OptionError, match="scale"):
        PLAIN.scaled(scale)

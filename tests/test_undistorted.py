"""Frames resampled to a pinhole: what a pinhole there would have seen, in closed form."""

import json

import cv2
import numpy as np
import pytest
import tube_sequence

import endotwin
from endotwin.cameras import Fisheye, Pinhole
from endotwin.errors import OptionError
from endotwin.sequence.readers import open_sequence
from endotwin.twin import Registration

FISHEYE = {"model": "fisheye", "width": 320, "height": 240, "fx": 150, "fy": 150, "cx": 161, "cy": 118}


@pytest.fixture(scope="module")
def distorted(tmp_path_factory):
    """A tube seen through a fisheye: each pixel the tube's own photograph along that pixel's ray."""
    folder = tube_sequence.write(tmp_path_factory.mktemp("undistorted") / "tube", 3, 320, 240)
    camera = Fisheye(**{key: value for key, value in FISHEYE.items() if key != "model"}, k1=0.02)
    wide = {"model": "pinhole", "width": 1000, "height": 800, "fx": 250, "fy": 250, "cx": 499.5, "cy": 399.5}
    u, v = (250 * camera.pixel_directions[..., k] / camera.pixel_directions[..., 2] for k in (0, 1))
    at = (u + 499.5).astype(np.float32), (v + 399.5).astype(np.float32)
    for index, pose in enumerate(tube_sequence.poses(3)):
        photo, depth_mm = tube_sequence.photograph(wide, pose)
        cv2.imwrite(
            str(folder / f"{index:04d}_color.png"), cv2.remap(photo, *at, cv2.INTER_LINEAR)[..., ::-1]
        )
        depth_mm = cv2.remap(depth_mm.astype(np.float32), *at, cv2.INTER_LINEAR)
        cv2.imwrite(str(folder / f"{index:04d}_depth.tiff"), np.uint16(depth_mm / 100 * 65535 + 0.5))
    (folder / "camera.json").write_text(json.dumps({**FISHEYE, "k1": 0.02}))
    return folder


def test_frames_are_what_a_pinhole_in_their_place_would_have_seen(distorted):
    sequence = open_sequence(distorted, undistort=(160, 120))
    camera = sequence.camera
    assert isinstance(camera, Pinhole) and (camera.cx, camera.cy) == (79.5, 59.5)
    assert camera.fx == pytest.approx(75, rel=0.01)  # the fisheye's in its middle, at half the width
    photo, depth_mm = tube_sequence.photograph(camera.to_dict(), sequence.T_world_camera[1])
    inside = sequence.lens_mask & np.isfinite(sequence.depth_mm(1))
    assert inside.mean() > 0.95
    # the nearest native pixel lies up to .7 pixels aside, where the wall runs away from the lens
    error = np.abs(sequence.depth_mm(1) - depth_mm)[inside] / depth_mm[inside]
    assert np.median(error) < 0.01 and np.percentile(error, 95) < 0.03
    assert np.abs(sequence.color(1).astype(float) - photo)[inside].mean() < 2


def test_a_twin_of_undistorted_frames_opens_them_so_again(distorted, tmp_path):
    twin = endotwin.fuse_twin(distorted, undistort=(160, 120))
    assert (twin.camera.model, twin.camera.width, twin.camera.height) == ("pinhole", 160, 120)
    twin.save(tmp_path / "twin")
    again = endotwin.Twin.load(tmp_path / "twin")
    assert again.sequence().camera == twin.camera
    np.testing.assert_array_equal(again.sequence().color(2), twin.sequence().color(2))
    half, halved = twin.source.at_scale(0.5).open().camera, twin.camera.scaled(0.5)
    np.testing.assert_allclose(half.matrix, halved.matrix, atol=0.3)
    assert (half.width, half.height) == (80, 60)
    assert twin.at_scale(0.5).camera == half and twin.at_scale(1.0).camera == twin.camera


def test_corrected_intrinsics_move_the_colour_that_a_ray_sees_and_leave_the_photo(distorted):
    ray, none = np.array([[0.1, -0.2, 1.0]]), ((0.0,) * 6,) * 3

    def seen(sequence, photo):
        at = sequence.camera.project(ray).astype(np.float32)
        return cv2.remap(photo, at[:, :1], at[:, 1:], cv2.INTER_LINEAR)[0, 0]

    def moved(sequence):
        """The photos before and after, and by how much the ray's colour changed."""
        corrected = Registration(none, intrinsics=(0.05, 0.03, -0.02)).applied(sequence)
        before, after = (each.color(1).astype(np.float32) for each in (sequence, corrected))
        return before, after, seen(corrected, after) - seen(sequence, before)

    *_, on_native = moved(open_sequence(distorted, scale=0.5))
    before, after, on_pinhole = moved(open_sequence(distorted, undistort=(160, 120)))
    np.testing.assert_array_equal(after, before)
    assert np.abs(on_native).max() > 10
    np.testing.assert_allclose(on_pinhole, on_native, atol=3)


def test_undistorted_frames_are_described_in_one_line_as_others_are(distorted):
    assert repr(open_sequence(distorted, undistort=(160, 120))).endswith(
        "tube: 3 frames, 160×120 pinhole, c3vd)"
    )


def test_a_size_that_enlarges_or_a_scale_beside_it_is_refused(distorted):
    with pytest.raises(OptionError, match="not wider"):
        open_sequence(distorted, undistort=(640, 480))
    with pytest.raises(OptionError, match=r"leave the scale out.*--scale 1"):
        open_sequence(distorted, undistort=(160, 120), scale=0.5)
    with pytest.raises(OptionError, match=r"leave the scale out.*--scale 1"):
        endotwin.fuse_twin(distorted, undistort=(160, 120), config="draft")

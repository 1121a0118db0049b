"""The lens circle against each camera model's own projection, and measured where it was put in."""

import cv2
import numpy as np
import pytest
import scenes
import torch

from endotwin.cameras import CALIBRATIONS, Fisheye, Pinhole
from endotwin.effects.lens import WHOLE_FIELD_DEG, Lens
from endotwin.sequence.readers import open_sequence

PINHOLE = Pinhole(160, 120, 70.0, 70.0, 82.0, 57.0)
FISHEYE = Fisheye(160, 120, 60.0, 60.0, 82.0, 57.0)


def radius_px(camera) -> np.ndarray:
    u, v = np.meshgrid(np.arange(camera.width) - camera.cx, np.arange(camera.height) - camera.cy)
    return np.hypot(u, v)


@pytest.mark.parametrize(
    ("camera", "radius"),
    [(PINHOLE, 70 * np.tan(np.radians(35))), (FISHEYE, 60 * np.radians(35))],
    ids=["pinhole f·tanθ", "fisheye f·θ"],
)
def test_the_circle_lies_where_the_projection_puts_the_angle(camera, radius):
    lens = Lens(35.0)
    assert np.array_equal(lens.mask(camera), radius_px(camera) <= radius)
    image = lens.through(torch.ones(120, 160, 3), None, camera)[..., 0].numpy()
    assert not image[radius_px(camera) > radius + 1].any()
    assert (image[radius_px(camera) < radius - 1] == 1).all()
    assert ((image > 0.5) == lens.mask(camera))[np.abs(radius_px(camera) - radius) > 0.01].all()


def test_the_circle_of_a_fisheye_is_out_of_a_narrower_pinhole_s_sight():
    narrow = Pinhole(160, 120, 160.0, 160.0, 79.5, 59.5)
    assert Lens(56.3).mask(narrow).all()
    assert not Lens(56.3).mask(CALIBRATIONS["c3vd-v1"].scaled(0.2)).all()


def test_no_stop_changes_nothing():
    image = torch.rand(120, 160, 3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(Lens().through(image, None, PINHOLE), image)


def test_directions_that_the_model_does_not_define_are_black():
    beyond = Fisheye(160, 120, 15.0, 15.0, 79.5, 59.5)
    assert np.isnan(beyond.pixel_directions).any()
    image = Lens(170.0).through(torch.ones(120, 160, 3), None, beyond)
    assert image.isfinite().all()
    assert not image[~torch.from_numpy(np.isfinite(beyond.pixel_directions).all(2))].any()


def test_the_stop_is_measured_from_the_black_of_the_photos(tmp_path):
    camera = scenes.omni(340, 272)
    sequence = scenes.sphere().sequence(tmp_path, camera, scenes.poses_all_round()[:2])
    angle = np.degrees(np.arccos(camera.pixel_directions[..., 2]))
    for file in sequence.color_files:
        photo = np.maximum(cv2.imread(str(file)), 60)
        photo[angle > 52.0] = 0
        cv2.imwrite(str(file), photo)
    lens, reason = Lens.evidence(sequence)
    assert lens.half_angle_deg == pytest.approx(52.0, abs=0.2)
    assert (lens.mask(camera) == (angle <= 52.0)).mean() > 0.995
    assert "black beyond" in reason


def test_a_pinhole_with_full_photos_needs_no_lens(tmp_path):
    poses = scenes.poses_all_round()[:1]
    assert Lens.evidence(scenes.sphere().sequence(tmp_path, scenes.pinhole(), poses))[0] is None


def test_a_distorted_camera_with_full_photos_has_no_stop(tmp_path):
    camera = Pinhole(160, 120, 80.0, 80.0, 79.5, 59.5, k1=-0.05)
    lens, reason = Lens.evidence(scenes.sphere().sequence(tmp_path, camera, scenes.poses_all_round()[:1]))
    assert lens.half_angle_deg == WHOLE_FIELD_DEG and "distortion" in reason


def test_the_circle_of_c3vd_s_lens_is_one_angle(data_root):
    sequence = open_sequence(data_root / "colon_fisheye")
    lens, agreement = Lens.measured(sequence.camera, sequence.lens_mask)
    assert lens.half_angle_deg == pytest.approx(56.3, abs=0.1) and agreement > 0.999

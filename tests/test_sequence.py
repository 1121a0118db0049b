"""The Sequence itself: scaling of photo and depth, the lens mask, and depth consistent between frames."""

import cv2
import numpy as np
import pytest
from c3vd_folder import write_c3vd
from scipy.ndimage import map_coordinates

from endotwin.errors import SequenceError
from endotwin.sequence.readers import open_sequence
from endotwin.sequence.sequence import dark_surround, resized_depth


def circle_image(height=120, width=160, radius=70, seed=0):
    """A lit disc in a black surround with noise of one grey level, uint8 [H, W], and the disc, bool."""
    v, u = np.mgrid[:height, :width]
    disc = np.hypot(u - width / 2, v - height / 2) < radius
    noise = np.random.default_rng(seed).integers(0, 3, (height, width))
    return np.where(disc, 120, noise).astype(np.uint8), disc


def test_the_black_surround_of_a_lens_circle_is_found_through_noise():
    image, disc = circle_image()
    np.testing.assert_array_equal(dark_surround(image), ~disc)


def test_a_dark_far_lumen_within_the_circle_is_kept():
    image, disc = circle_image()
    image[50:70, 70:90] = 0
    np.testing.assert_array_equal(dark_surround(image), ~disc)


def test_a_picture_without_a_surround_is_kept_whole_although_its_corner_pixels_are_black():
    image = np.full((120, 160), 90, np.uint8)
    image[:3, :3] = 0
    image[40:80, 60:100] = 0
    assert not dark_surround(image).any()


def test_text_in_the_surround_is_not_the_lens():
    image, disc = circle_image()
    image[3:6, 2:8] = 255
    np.testing.assert_array_equal(dark_surround(image), ~disc)


def test_reduced_depth_of_a_slope_is_its_depth_at_the_new_pixel_centres():
    u = np.arange(64)
    depth_mm = np.tile(20 + 0.05 * u, (48, 1)).astype(np.float32)
    reduced = resized_depth(depth_mm, 32, 24)
    expected = 20 + 0.05 * ((np.arange(32) + 0.5) * 2 - 0.5)
    np.testing.assert_allclose(reduced, np.tile(expected, (24, 1)), atol=1e-5)


@pytest.mark.parametrize("size", [(32, 24), (23, 17), (20, 15), (100, 75)])
def test_resized_depth_holds_no_value_between_the_two_sides_of_a_jump(size):
    rng = np.random.default_rng(1)
    near = rng.random((48, 64)) < 0.5
    resized = resized_depth(np.where(near, 10, 40).astype(np.float32), *size)
    assert set(np.unique(resized)) == {np.float32(10), np.float32(40)}


def test_resized_depth_next_to_missing_depth_is_never_pulled_towards_zero():
    depth_mm = np.full((48, 64), 30, np.float32)
    depth_mm[::5, ::3] = np.nan
    resized = resized_depth(depth_mm, 32, 24)
    np.testing.assert_array_equal(resized[np.isfinite(resized)], 30)
    assert 0 < np.isnan(resized).sum() < resized.size / 2


def test_lens_mask_of_a_sequence_is_the_circle_at_any_scale(tmp_path):
    disc = circle_image(48, 64, 24)[1]
    color = [cv2.merge([circle_image(48, 64, 24, seed)[0]] * 3) for seed in range(3)]
    folder = write_c3vd(tmp_path / "c3vd", color=color)
    np.testing.assert_array_equal(open_sequence(folder).lens_mask, disc)
    half = open_sequence(folder, scale=0.5).lens_mask
    whole_blocks = disc.reshape(24, 2, 32, 2).all(axis=(1, 3))
    np.testing.assert_array_equal(half, whole_blocks)


def test_a_pixel_dark_in_one_frame_only_is_within_the_lens(tmp_path):
    color = [np.full((48, 64, 3), 80, np.uint8) for _ in range(3)]
    color[1][:] = 0
    assert open_sequence(write_c3vd(tmp_path / "c3vd", color=color)).lens_mask.all()


def test_a_scaled_frame_fits_its_camera(tmp_path):
    sequence = open_sequence(write_c3vd(tmp_path / "c3vd"), scale=0.37)
    frame = sequence.frame(1)
    size = (sequence.camera.height, sequence.camera.width)
    assert size == (18, 24)
    assert frame.color.shape == (*size, 3)
    assert frame.depth_mm.shape == size


def test_a_sequence_without_any_valid_depth_is_refused(tmp_path):
    sequence = open_sequence(write_c3vd(tmp_path / "c3vd", depth=[np.zeros((48, 64), np.uint16)] * 3))
    assert np.isnan(sequence.depth_mm(0)).all()
    with pytest.raises(SequenceError, match="no valid depth"):
        sequence.require_valid_depth()


def test_one_valid_pixel_is_enough_to_have_depth(tmp_path):
    depth = [np.zeros((48, 64), np.uint16) for _ in range(3)]
    depth[2][5, 6] = 30000
    open_sequence(write_c3vd(tmp_path / "c3vd", depth=depth)).require_valid_depth()


@pytest.mark.parametrize("scale", [1, 0.5])
@pytest.mark.parametrize("name", ["colon_direct", "colon_fisheye"])
def test_depth_of_one_frame_lands_on_the_depth_of_the_next(data_root, name, scale):
    sequence = open_sequence(data_root / name, scale=scale)
    camera, (first, second) = sequence.camera, sequence.T_world_camera[:2]
    rays, depth_mm = camera.pixel_directions.astype(np.float64), sequence.depth_mm(0)
    seen = np.isfinite(depth_mm) & (rays[..., 2] > 0.05)
    points = np.c_[(rays / rays[..., 2:] * depth_mm[..., None])[seen], np.ones(seen.sum())]
    moved = (points @ (np.linalg.inv(second) @ first).T)[:, :3]
    uv = camera.project(moved)
    inside = (uv >= 0).all(axis=1) & (uv <= (camera.width - 1, camera.height - 1)).all(axis=1)
    there_mm = map_coordinates(sequence.depth_mm(1), uv[inside][:, ::-1].T, order=1)
    assert np.nanmedian(np.abs(there_mm - moved[inside, 2])) < 0.005


def test_lens_mask_of_c3vds_lens_leaves_its_black_corners_out(data_root):
    sequence = open_sequence(data_root / "colon_fisheye")
    assert sequence.lens_mask.mean() == pytest.approx(0.797, abs=0.01)
    assert (sequence.camera.pixel_directions[..., 2][sequence.lens_mask] > 0).all()


def test_lens_mask_of_a_pinhole_picture_is_all_of_it(data_root):
    assert open_sequence(data_root / "colon_direct").lens_mask.all()

"""Whether a fit tells that it leaves more of the photos than their noise."""

import cv2
import numpy as np
import pytest
import tube_sequence
from c3vd_folder import CAMERA, write_c3vd

import endotwin
from endotwin.effects import Decision
from endotwin.fit.unexplained import Remains, odd_photos_warning, residual_warning
from endotwin.sequence.readers import open_sequence

DECISIONS = {
    "gain": Decision("off", "", 0.15),
    "offset": Decision("off", "", 0.02),
    "coat": Decision("on", "", 1.0),
}


@pytest.fixture(scope="module")
def noisy(tmp_path_factory):
    """Flat grey photos with noise of three levels."""
    generator = np.random.default_rng(0)
    photos = np.clip(128 + generator.normal(0, 3, (4, 240, 320, 3)), 0, 255).astype(np.uint8)
    depth = np.full((240, 320), 30000, np.uint16)
    camera = {**CAMERA, "width": 320, "height": 240}
    folder = tmp_path_factory.mktemp("noisy")
    return open_sequence(write_c3vd(folder, list(photos), [depth] * len(photos), camera=camera))


def test_what_the_noise_leaves_is_not_told(noisy):
    assert residual_warning(3.5 / 255, noisy, DECISIONS) is None


def test_what_is_left_beyond_the_noise_is_told_with_its_suspect(noisy):
    said = residual_warning(12 / 255, noisy, DECISIONS)
    assert "12.0 of 255 levels" in said and "4 times" in said and "suspect gain" in said


def blurred(photo: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(photo, (0, 0), 4)


def smeared(photo: np.ndarray) -> np.ndarray:
    """Half of it veiled, and blurred."""
    veil = np.linspace(-1, 1, photo.shape[1]).clip(0)[:, None]
    return photo * (1 - veil) + (0.7 * blurred(photo) + 50) * veil


def test_photos_that_are_not_like_the_others_are_named_and_clean_ones_are_not(tmp_path, caplog):
    folder = tube_sequence.write(tmp_path / "tube", 16, 96, 72)
    endotwin.fit_twin(endotwin.fuse_twin(folder), align="off")
    assert "--without" not in caplog.text
    for index, spoil in {3: blurred, 11: smeared}.items():
        file = str(folder / f"{index:04d}_color.png")
        cv2.imwrite(file, np.rint(spoil(cv2.imread(file))).astype(np.uint8))
    endotwin.fit_twin(endotwin.fuse_twin(folder), align="off")
    (said,) = [record.message for record in caplog.records if "--without" in record.message]
    assert "--without 3,11'" in said
    assert "is it blurred?" in said and "photo 11 departs from the fit" in said


def remains(**off: np.ndarray) -> Remains:
    """Nine photos from the tenth on, of which the last shows nothing, that agree but for what is ``off``."""
    nothing = np.r_[np.zeros(8), np.nan]
    casts = np.repeat(nothing[:, None], 3, axis=1)
    alike = {"sigmas": 0.01 + nothing, "casts": 0.01 + casts, "detail": 1 + nothing}
    return Remains(0.01, **{**alike, **off}, frames=np.arange(10, 19))


def test_photos_that_agree_are_none_of_them_odd():
    assert odd_photos_warning(remains()) is None
    none = np.full(9, np.nan)
    assert odd_photos_warning(remains(sigmas=none, casts=np.repeat(none[:, None], 3, 1), detail=none)) is None


def test_the_worst_photo_is_told_by_its_channel_and_those_beside_it_by_number():
    casts = np.full((9, 3), 0.01)  # what all have in common is no cast of any
    casts[4, 2], casts[7, 0], casts[8] = 0.2, -0.1, np.nan
    said = odd_photos_warning(remains(casts=casts))
    assert said.startswith("photo 14 is 21 % more blue") and "--without 14,17'" in said
    casts[[4, 7]] = 0.01
    assert odd_photos_warning(remains(casts=casts)) is None


def test_blurred_photos_and_those_that_are_amiss_are_left_out_together():
    detail, sigmas = np.full(9, 1.1), np.full(9, 0.02)
    detail[3], sigmas[[1, 6]] = 0.55, (0.05, 0.08)
    said = odd_photos_warning(remains(detail=detail, sigmas=sigmas))
    assert "photo 13 shows 50 % of the detail" in said and "photo 16 departs from the fit 4.0 times" in said
    assert "--without 11,13,16'" in said


def test_where_all_photos_differ_none_is_singled_out():
    rng = np.random.default_rng(0)
    casts, detail, sigmas = rng.normal(0, 0.1, (9, 3)), rng.uniform(0.2, 1.8, 9), np.exp(rng.normal(0, 1, 9))
    assert odd_photos_warning(remains(casts=casts, detail=detail, sigmas=sigmas)) is None

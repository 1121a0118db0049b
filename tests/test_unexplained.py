"""Whether a fit tells that it leaves more of the photos than their noise."""

import cv2
import numpy as np
import pytest
import tube_sequence
from c3vd_folder import CAMERA, write_c3vd

import endotwin
from endotwin.effects import Decision
from endotwin.fit.unexplained import Remains, cast_warning, residual_warning
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


def test_a_photo_that_is_less_red_than_the_others_of_the_same_places_is_named_and_clean_ones_are_not(
    tmp_path, caplog
):
    folder = tube_sequence.write(tmp_path / "tube", 12, 96, 72)
    endotwin.fit_twin(endotwin.fuse_twin(folder))
    assert "balance" not in caplog.text
    photo = cv2.imread(str(folder / "0005_color.png"))
    photo[..., 2] = np.rint(0.85 * photo[..., 2])
    cv2.imwrite(str(folder / "0005_color.png"), photo)
    endotwin.fit_twin(endotwin.fuse_twin(folder))
    said = [record.message for record in caplog.records if "balance" in record.message]
    assert len(said) == 1 and said[0].startswith("photo 5 is ") and "% less red" in said[0]
    percent = int(said[0].split()[3])
    assert 9 <= percent <= 15  # the places' own colour takes a share, as the other photos outvote this one


def test_the_worst_photo_is_told_by_its_channel_and_those_beside_it_by_number():
    casts = np.full((9, 3), 0.01)  # what all have in common is no cast of any
    casts[4, 2], casts[7, 0], casts[8] = 0.2, -0.1, np.nan
    said = cast_warning(Remains(0.01, casts, np.arange(10, 19)))
    assert said.startswith("photo 14 is 21 % more blue") and "--without 14,17'" in said
    casts[[4, 7]] = 0.01
    assert cast_warning(Remains(0.01, casts, np.arange(10, 19))) is None


def test_where_all_photos_differ_none_is_singled_out():
    casts = np.random.default_rng(0).normal(0, 0.1, (20, 3))
    assert cast_warning(Remains(0.01, casts, np.arange(20))) is None

"""Photos of another white balance than the rest."""

import cv2
import numpy as np
import pytest
import torch
import tube_sequence

import endotwin
from endotwin.effects.tone import Tone
from endotwin.pixels.casts import LEAST_CAST, Casts, standing_out
from endotwin.pixels.samples import Samples

CASTS = Casts(np.array([2, 5]), np.array([[-0.08, 0.0, 0.01], [0.05, 0.0, -0.06]]))


def samples_of(color: np.ndarray, frame: np.ndarray) -> Samples:
    none = torch.zeros(len(color))
    columns = dict.fromkeys(("cos", "sin2", "log_cos_axis", "log_distance", "triangle", "pixel"), none)
    color, frame = torch.from_numpy(color), torch.from_numpy(frame.astype(np.int32))
    return Samples(barycentric=none, color=color, frame=frame, **columns)


@pytest.mark.parametrize("contrast", [0.0, 0.4])
def test_casts_are_taken_off_beneath_the_tone_curve_to_a_level(contrast):
    generator, tone = np.random.default_rng(0), Tone(contrast)
    linear = generator.uniform(0.1, 0.8, (3000, 3))
    frame = generator.integers(0, 8, 3000)
    cast = np.zeros((8, 3))
    cast[CASTS.frames] = CASTS.log

    def photo(linear: np.ndarray) -> np.ndarray:
        return np.rint(255 * tone.shown(torch.from_numpy(linear)).numpy()).astype(np.uint8)

    spoilt = samples_of(photo(linear * np.exp(cast[frame])), frame)
    mended = CASTS.taken_off(spoilt, tone).color.numpy().astype(int)
    assert np.abs(mended - photo(linear)).max() <= 1
    untouched = ~np.isin(frame, CASTS.frames)
    np.testing.assert_array_equal(mended[untouched], spoilt.color.numpy()[untouched])


def test_what_is_clipped_stays_so_and_nothing_else_passes_white():
    color = np.array([[255, 255, 255], [250, 250, 250], [0, 0, 0]], np.uint8)
    mended = CASTS.taken_off(samples_of(color, np.full(3, 2))).color.numpy()
    assert mended[0].tolist() == [255] * 3 and mended[1].tolist() == [255, 250, 248] and not mended[2].any()


@pytest.mark.parametrize("odd", [[], [7], [13, 21], [9, 10, 11, 12]])
def test_photos_whose_hue_jumps_stand_out_and_those_into_which_it_drifts_do_not(odd):
    count = 22
    drift = np.stack([np.linspace(0.5, -0.5, count) ** 3, 0.01 * np.sin(np.arange(count))], axis=1)
    log = 0.4 * drift + np.isin(np.arange(count), odd)[:, None] * [-0.12, 0.03]
    assert np.abs(np.diff(0.4 * drift, axis=0)).max() < LEAST_CAST < np.abs(0.4 * drift).max()
    assert np.flatnonzero(standing_out(log, np.abs(log))).tolist() == odd
    assert not standing_out(log, 0 * log).any()


def test_a_photo_of_another_white_balance_bends_no_fit(tmp_path, caplog):
    folder = tube_sequence.write(tmp_path / "tube", 16, 96, 72)
    clean = endotwin.fit_twin(endotwin.fuse_twin(folder), align="off")
    assert "white balance" not in caplog.text
    file = str(folder / "0005_color.png")
    cv2.imwrite(file, np.rint(cv2.imread(file) * [1, 1, 0.85]).astype(np.uint8))
    spoilt = endotwin.fit_twin(endotwin.fuse_twin(folder), align="off")
    assert "photo 5 is 15 % less red than the other photos" in caplog.text
    assert "--without" not in caplog.text
    assert spoilt.response.gamma == pytest.approx(clean.response.gamma, rel=0.005)
    assert spoilt.light.n == pytest.approx(clean.light.n, rel=0.01)
    np.testing.assert_allclose(spoilt.materials.base_color, clean.materials.base_color, atol=0.02)
    assert list(spoilt.record["fit"]["casts_undone"]) == ["5"]

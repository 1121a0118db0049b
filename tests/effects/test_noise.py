"""Sensor noise against the moments that it must have, and measured against noise of known strength."""

import json

import cv2
import numpy as np
import pytest
import torch
from scipy import stats

from endotwin.effects.noise import LEVEL, Noise
from endotwin.sequence.readers import open_sequence

SHAPE = (480, 640)
EVERYWHERE = np.ones(SHAPE, bool)


def textured(seed: int) -> np.ndarray:
    """A noiseless picture float32 [H, W, 3] in display values: shading, blobs and thin lines."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]] / SHAPE[1]
    blobs = cv2.GaussianBlur(rng.standard_normal((*SHAPE, 3)), (0, 0), 5)
    picture = 0.15 + 0.75 * u[..., None] + 0.05 * blobs / blobs.std()
    for _ in range(40):
        ends = (rng.uniform(0, 1, (2, 2)) * SHAPE[::-1]).astype(int)
        cv2.line(
            picture, ends[0].tolist(), ends[1].tolist(), rng.uniform(0.2, 0.9, 3).tolist(), 2, cv2.LINE_AA
        )
    return (picture + 0.1 * np.sin(8 * v)[..., None]).clip(0.1, 0.92).astype(np.float32)


def eight_bit(color: np.ndarray) -> np.ndarray:
    return np.rint(255 * color).astype(np.uint8)


@pytest.mark.parametrize("grey", [0.2, 0.5, 0.8])
def test_noise_is_gaussian_with_the_variance_of_read_and_shot(grey):
    noise = Noise(read_noise=0.01, shot_noise=4e-4)
    residual = (
        noise.read(np.full((*SHAPE, 3), grey, np.float32), np.random.default_rng(1)).astype(float) - grey
    )
    expected = 0.01**2 + 4e-4 * grey
    count = residual.size
    low, high = stats.chi2.interval(0.9999, count) / np.array(count)
    assert low < (residual**2).mean() / expected < high
    assert abs(residual.mean()) < 4 * np.sqrt(expected / count)
    assert stats.kstest(residual.ravel()[::7] / np.sqrt(expected), "norm").pvalue > 1e-4


def test_channels_and_neighbours_are_independent():
    residual = Noise(0.02).read(np.full((*SHAPE, 3), 0.5, np.float32), np.random.default_rng(2)) - 0.5
    pairs = [
        (residual[..., 0], residual[..., 1]),
        (residual[:, 1:], residual[:, :-1]),
        (residual[1:], residual[:-1]),
    ]
    for a, b in pairs:
        assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 4 / np.sqrt(a.size)


def test_the_generator_alone_decides_the_noise():
    color = textured(0)
    first, again, other = (Noise(0.01).read(color, np.random.default_rng(seed)) for seed in (5, 5, 6))
    assert np.array_equal(first, again) and not np.array_equal(first, other)


def test_what_the_sensor_reads_stays_in_range_and_its_kind():
    color = torch.linspace(0, 1, 300).reshape(10, 10, 3)
    read = Noise(0.2, 0.05).read(color, np.random.default_rng(0))
    assert isinstance(read, torch.Tensor) and read.dtype == torch.float32
    assert read.min() == 0 and read.max() == 1
    assert Noise().read(np.zeros((0, 4, 3), np.float32), np.random.default_rng(0)).shape == (0, 4, 3)


@pytest.mark.parametrize(
    "truth", [Noise(LEVEL), Noise(0.02), Noise(0.003, 1e-4), Noise(0.0, 5e-4), Noise(0.01, 1e-3)], ids=str
)
def test_known_noise_is_measured_within_ten_percent_and_without_the_rounding(truth):
    rng = np.random.default_rng(3)
    photos = [eight_bit(truth.read(textured(seed), rng)) for seed in range(3)]
    found = Noise.measured_in(photos, EVERYWHERE)
    for grey in (0.25, 0.5, 0.75):
        assert found.sigma(grey) == pytest.approx(truth.sigma(grey), rel=0.1)


def test_rendering_with_the_measured_noise_measures_the_same_again():
    first = Noise.measured_in(
        [eight_bit(Noise(0.008, 2e-4).read(textured(0), np.random.default_rng(1)))], EVERYWHERE
    )
    rendered = eight_bit(first.read(textured(1), np.random.default_rng(2)))
    assert Noise.measured_in([rendered], EVERYWHERE).sigma(0.5) == pytest.approx(first.sigma(0.5), rel=0.1)


def test_rounding_alone_is_not_taken_for_noise():
    found = Noise.measured_in([eight_bit(textured(seed)) for seed in range(3)], EVERYWHERE)
    assert found.sigma(0.5) < 0.3 * LEVEL


def test_pixels_outside_the_mask_do_not_count():
    photo = eight_bit(Noise(0.01).read(textured(0), np.random.default_rng(1)))
    photo[:, :320] = np.random.default_rng(2).integers(0, 255, (480, 320, 3))
    mask = EVERYWHERE.copy()
    mask[:, :330] = False
    assert Noise.measured_in([photo], mask).sigma(0.5) == pytest.approx(0.01, rel=0.1)


@pytest.mark.parametrize("photo", [np.zeros((64, 64, 3), np.uint8), np.full((6, 6, 3), 99, np.uint8)])
def test_photos_that_show_no_noise_measure_none(photo):
    assert Noise.measured_in([photo], np.ones(photo.shape[:2], bool)) is None


def test_the_noise_of_the_example_is_what_its_renderer_added(example):
    truth = json.loads((example / "truth" / "made.json").read_text())["noise_levels"] * LEVEL
    found, reason = Noise.evidence(open_sequence(example))
    assert found.sigma(0.5) == pytest.approx(truth, rel=0.1)
    assert "levels" in reason


@pytest.mark.parametrize("name", ["colon_direct", "colon_gi", "colon_offset", "colon_fisheye"])
def test_the_noise_of_path_traced_colons_is_one_level(data_root, name):
    assert Noise.measured(open_sequence(data_root / name)).sigma(0.5) == pytest.approx(LEVEL, rel=0.1)

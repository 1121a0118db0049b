"""Corruptions of photos: what each does to an image, and that more severe is more."""

import cv2
import numpy as np
import pytest

from endotwin.sequence.images import read_color
from endotwin.study.corruptions import BENCHMARK, CORRUPTIONS, SEVERITIES, as_jpeg, corrupted


@pytest.fixture(scope="module")
def photo(example):
    """A photo of the example, at the size that the strengths are meant for."""
    file = sorted(example.glob("*_color.*"))[0]
    return cv2.resize(read_color(file), (320, 256), interpolation=cv2.INTER_AREA)


def test_they_are_the_sixteen_of_the_benchmark_and_the_codec():
    assert len(BENCHMARK) == 16 and list(CORRUPTIONS) == [*BENCHMARK, "jpeg"]


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_size_and_type_stay_and_the_same_seed_gives_the_same_image(photo, name):
    before = photo.copy()
    once, again = (corrupted(photo, name, 3, seed=5) for _ in range(2))
    assert once.dtype == np.uint8 and once.shape == photo.shape
    assert np.array_equal(once, again) and np.array_equal(photo, before)
    assert not np.array_equal(once, photo)


def difference(photo: np.ndarray, image: np.ndarray) -> float:
    return float(np.abs(photo.astype(float) - image).mean())


def unlikeness(photo: np.ndarray, image: np.ndarray) -> float:
    """How little of the photo is left beside what is laid over it."""
    return 1 - float(np.corrcoef(photo.ravel(), image.ravel())[0, 1])


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_a_greater_severity_is_farther_from_the_photo(photo, name):
    seeds = range(6) if name in ("color_changes", "specular_reflection", "motion_blur", "fog") else range(2)
    measure = unlikeness if name == "fog" else difference
    distance = [
        np.mean([measure(photo, corrupted(photo, name, severity, seed)) for seed in seeds])
        for severity in ((1, 3, 5) if name in ("fog", "glass_blur") else SEVERITIES)  # as published
    ]
    assert (np.diff(distance) > 0).all(), distance


@pytest.mark.parametrize("name", ["gaussian_noise", "impulse_noise", "shot_noise", "iso_noise", "glass_blur"])
def test_another_seed_gives_another_image(photo, name):
    assert not np.array_equal(corrupted(photo, name, 2, 0), corrupted(photo, name, 2, 1))


def test_brightness_and_darkness_move_the_value_by_a_tenth_a_level():
    grey = np.full((32, 40, 3), 128, np.uint8)
    for severity in SEVERITIES:
        assert (corrupted(grey, "brightness", severity, 0).astype(int) - 128) / 255 == pytest.approx(
            min(0.1 * severity, 127 / 255), abs=3e-3
        )
        assert (128 - corrupted(grey, "darkness", severity, 0).astype(int)) / 255 == pytest.approx(
            min(0.1 * severity, 128 / 255), abs=3e-3
        )


def test_contrast_keeps_the_mean_and_shrinks_the_deviation(photo):
    for severity, factor in zip(SEVERITIES, (0.4, 0.3, 0.2, 0.1, 0.05), strict=True):
        image = corrupted(photo, "contrast", severity, 0).astype(float)
        assert image.mean() == pytest.approx(photo.mean(), abs=0.5)
        assert image.std(axis=(0, 1)) == pytest.approx(factor * photo.std(axis=(0, 1)), abs=0.4)


@pytest.mark.parametrize(
    "name", ["defocus_blur", "glass_blur", "motion_blur", "zoom_blur", "resolution_change"]
)
def test_blur_leaves_an_even_image_alone(name):
    even = np.full((64, 80, 3), (200, 90, 60), np.uint8)
    assert np.abs(corrupted(even, name, 5, 0)[8:-8, 8:-8].astype(int) - even[8:-8, 8:-8]).max() <= 1


@pytest.mark.parametrize("name", ["defocus_blur", "motion_blur"])
def test_blur_keeps_the_light_of_a_point(name):
    point = np.zeros((101, 101, 3), np.uint8)
    point[48:53, 48:53] = 255
    for severity in (1, 3):
        blurred = corrupted(point, name, severity, 0)
        assert float(blurred.sum()) == pytest.approx(float(point.sum()), rel=0.08)


def test_noise_has_its_deviation():
    grey = np.full((200, 200, 3), 128, np.uint8)
    assert corrupted(grey, "gaussian_noise", 1, 0).std() / 255 == pytest.approx(0.08, rel=0.02)
    assert corrupted(grey, "shot_noise", 1, 0).std() / 255 == pytest.approx(np.sqrt(128 / 255 / 60), rel=0.03)
    flipped = np.isin(corrupted(grey, "impulse_noise", 4, 0), (0, 255)).mean()
    assert flipped == pytest.approx(0.17, rel=0.03)


def test_lens_distortion_leaves_the_centre_and_moves_the_corners_by_its_polynomial():
    rows, columns = np.indices((201, 301))
    ramp = np.stack([columns * 200 / 300, rows * 200 / 200, np.zeros((201, 301))], axis=-1)
    image = corrupted(np.rint(ramp).astype(np.uint8), "lens_distortion", 5, 0)
    assert image[100, 150] == pytest.approx([100, 100, 0], abs=1)
    x = 0.6  # of half the width, on the middle row: seen there is what was at x (1 + k x²)
    assert image[100, 150 + 90, 0] == pytest.approx(100 * (1 + x * (1 + 0.05 * x**2)), abs=1)


def test_a_reflection_brightens_a_hundredth_of_the_image():
    black = np.zeros((100, 200, 3), np.uint8)
    image = corrupted(black, "specular_reflection", 4, 1)
    assert (image > 0).all(axis=2).mean() == pytest.approx(0.01)
    assert image.max() == pytest.approx(0.4 * 255, abs=1)


def test_a_codec_of_best_quality_changes_little(photo):
    assert np.abs(as_jpeg(photo, 100).astype(int) - photo).mean() < 2

"""The video processor against closed forms: fixed points, the overshoot at an edge, colours that stay."""

import numpy as np
import pytest
from photos import levels, textured
from scipy.special import erf

from endotwin.effects.luma import LUMA
from endotwin.effects.processor import Processor


def edge(low: float, high: float) -> np.ndarray:
    image = np.full((40, 80, 3), low, np.float32)
    image[:, 40:] = high
    return image


@pytest.mark.parametrize("contrast", [0.0, 0.5, 1.0])
def test_the_tone_curve_rises_and_keeps_black_middle_and_white(contrast):
    ramp = np.repeat(np.linspace(0, 1, 256, dtype=np.float32)[None, :, None], 3, axis=2)
    toned = Processor(contrast, 0.0).recorded(ramp)[0, :, 0]
    assert np.all(np.diff(toned) >= -1e-7)
    middle = Processor(contrast, 0.0).recorded(np.full((1, 1, 3), 0.5, np.float32))
    np.testing.assert_allclose([toned[0], middle.max(), toned[-1]], [0, 0.5, 1], atol=1e-6)
    if contrast:
        slope = np.diff(toned) * 255
        assert slope[127] == pytest.approx(1 + contrast / 2, rel=0.01)


def test_an_edge_overshoots_by_the_gaussians_integral():
    sigma, amount = 2.0, 0.5
    found = Processor(0.0, amount, sigma).recorded(edge(0.4, 0.6))[20, :, 1]
    x = np.arange(80) - 39.5
    blurred = 0.5 + 0.1 * erf(x / (np.sqrt(2) * sigma))
    expected = np.where(x > 0, 0.6, 0.4)
    np.testing.assert_allclose(found, expected + amount * (expected - blurred), atol=2e-3)


def test_even_areas_and_colour_differences_stay():
    even = np.full((32, 32, 3), (0.7, 0.3, 0.2), np.float32)
    np.testing.assert_allclose(Processor(0.0, 3.0, 3.0).recorded(even), even, atol=1e-6)
    image = np.random.default_rng(0).uniform(0.4, 0.6, (32, 32, 3)).astype(np.float32)
    found = Processor(0.0, 0.4).recorded(image)
    for one, other in ((0, 1), (2, 1)):
        np.testing.assert_allclose(
            found[..., one] - found[..., other], image[..., one] - image[..., other], atol=1e-5
        )
    assert np.std(found @ LUMA) > 1.2 * np.std(image @ LUMA)


@pytest.mark.parametrize(("amount", "radius"), [(0.6, 1.2), (1.5, 2.5), (4.0, 1.2)])
def test_a_sharpened_photo_is_told_what_it_was_to_a_level(amount, radius):
    color = 0.3 + 0.4 * textured(1)
    sharpened = levels(Processor(0.0, amount, radius).recorded(color))
    left = Processor(0.0, amount, radius).unsharpened(sharpened) - levels(color).astype(float)
    assert np.abs(left).max() <= 2
    assert left.std() < 0.7 < (sharpened - levels(color).astype(float)).std()


def test_black_and_white_of_a_sharpened_photo_stay():
    photo = np.uint8(np.random.default_rng(2).uniform(30, 220, (40, 50, 3)))
    photo[:, :10], photo[10:20, 20:30, 0] = 0, 255
    found = Processor(0.0, 0.8).unsharpened(photo)
    kept = (photo.max(axis=2) == 0) | (photo.max(axis=2) == 255)
    assert (found[kept] == photo[kept]).all() and (found[~kept] != photo[~kept]).any()


def test_photos_that_were_not_sharpened_are_left_as_they_are():
    photo = levels(textured(3))
    assert (Processor(0.0, 0.0).unsharpened(photo) == photo).all()

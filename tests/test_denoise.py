"""Averaging of noise in depth."""

import numpy as np
import pytest

from endotwin.fusion.denoise import denoised, pixel_noise
from endotwin.fusion.views import View

NOISE = 0.01


def stepped():
    """A slanted wall at 20 mm, and from column 40 on another at 30 mm; a gap without depth."""
    distance_mm = 20 + np.add.outer(0.02 * np.arange(60), 0.03 * np.arange(80))
    distance_mm[:, 40:] += 10
    distance_mm[20:24, 10:14] = np.nan
    return distance_mm


def noisy(seed=0):
    distance_mm = stepped()
    distance_mm *= 1 + NOISE * np.random.default_rng(seed).normal(size=distance_mm.shape)
    return View(0, np.eye(4), distance_mm.astype(np.float32))


def test_the_noise_that_was_added_is_measured():
    assert pixel_noise([noisy(0), noisy(1)]) == pytest.approx(NOISE, rel=0.1)


def test_a_slanted_wall_has_no_noise():
    assert pixel_noise([View(0, np.eye(4), stepped().astype(np.float32))]) < NOISE / 1000


def test_noise_falls_to_a_third_and_the_step_stays_where_it_is():
    error = denoised(noisy(), NOISE, 2.0).distance_mm / stepped() - 1
    assert np.nanstd(error) < NOISE / 3
    assert np.nanmax(np.abs(error)) < 4 * NOISE


def test_nothing_is_measured_that_was_not_before():
    view = noisy()
    np.testing.assert_array_equal(
        np.isnan(denoised(view, NOISE, 4.0).distance_mm), np.isnan(view.distance_mm)
    )

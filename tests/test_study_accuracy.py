"""Numbers of depth networks, against closed forms."""

import numpy as np
import pytest

from endotwin.study.accuracy import FARTHEST_MM, METRICS, accuracy, error_by_depth, median_scaled


@pytest.fixture
def depth_mm():
    depth_mm = np.random.default_rng(0).uniform(5, 60, (20, 30)).astype(np.float32)
    depth_mm[:3] = np.nan
    return depth_mm


def test_a_perfect_prediction_has_no_error(depth_mm):
    assert accuracy(depth_mm, np.nan_to_num(depth_mm, nan=7)) == {
        **dict.fromkeys(("abs_rel", "sq_rel", "rmse", "rmse_log"), 0.0),
        **dict.fromkeys(("d1", "d2", "d3"), 1.0),
    }


def test_a_common_factor_gives_the_closed_forms(depth_mm):
    factor, d = 1.3, depth_mm[np.isfinite(depth_mm)].astype(float)
    found = accuracy(depth_mm, factor * depth_mm)
    assert found["abs_rel"] == pytest.approx(0.3, rel=1e-5)
    assert found["sq_rel"] == pytest.approx(0.09 * d.mean(), rel=1e-5)
    assert found["rmse"] == pytest.approx(0.3 * np.sqrt((d**2).mean()), rel=1e-5)
    assert found["rmse_log"] == pytest.approx(np.log(1.3), rel=1e-5)
    assert (found["d1"], found["d2"], found["d3"]) == (0, 1, 1)


def test_a_ratio_counts_as_its_inverse_does():
    depth_mm = np.full((4, 4), 20.0)
    for ratio, within in ((1.24, (1, 1, 1)), (1.26, (0, 1, 1)), (1.6, (0, 0, 1)), (2.0, (0, 0, 0))):
        for predicted_mm in (depth_mm * ratio, depth_mm / ratio):
            found = accuracy(depth_mm, predicted_mm)
            assert (found["d1"], found["d2"], found["d3"]) == within


def test_the_median_scale_undoes_any_factor(depth_mm):
    found = accuracy(depth_mm, median_scaled(depth_mm, 0.37 * depth_mm))
    assert found["abs_rel"] == pytest.approx(0, abs=1e-6)


def test_predictions_are_clipped_to_the_range_of_the_data():
    depth_mm = np.full((2, 2), 50.0)
    assert accuracy(depth_mm, np.full((2, 2), 1e9))["abs_rel"] == FARTHEST_MM / 50 - 1
    assert np.isfinite(accuracy(depth_mm, np.zeros((2, 2)))["rmse_log"])


def test_depth_beyond_what_is_predicted_is_not_judged(depth_mm):
    farther = np.where(np.arange(30) < 3, 1.5 * FARTHEST_MM, depth_mm)
    within = np.where(np.arange(30) < 3, np.nan, depth_mm)
    assert accuracy(farther, 1.1 * farther) == accuracy(within, 1.1 * farther)


def test_an_image_without_depth_has_no_score():
    found = accuracy(np.full((2, 2), np.nan), np.ones((2, 2)))
    assert set(found) == set(METRICS) and np.isnan(list(found.values())).all()


def test_errors_by_depth_fall_into_their_bins_and_count_every_pixel(depth_mm):
    error, count = error_by_depth(depth_mm, 1.1 * depth_mm)
    assert count.sum() == np.isfinite(depth_mm).sum() and count[7:].sum() == 0
    assert error[count > 0] / count[count > 0] == pytest.approx(0.1, rel=1e-5)

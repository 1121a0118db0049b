"""Robust spreads against SciPy's."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy.stats import median_abs_deviation

from endotwin.robust import robust_std


@given(arrays.arrays(float, st.integers(1, 50), elements=st.floats(-1e6, 1e6)))
def test_of_residuals_about_zero_it_is_scipys_median_absolute_deviation(residual):
    about_zero = np.r_[residual, -residual]
    assert robust_std(about_zero) == pytest.approx(median_abs_deviation(about_zero, scale="normal"), rel=1e-4)


def test_a_tenth_of_outliers_widens_it_by_no_more_than_a_fifth():
    residual = np.random.default_rng(0).normal(0, 3.0, (1000, 3))
    residual[::10] = 1e9
    assert robust_std(residual) == pytest.approx(3.0, rel=0.2)


def test_without_residuals_or_where_they_agree_it_is_the_least():
    assert robust_std(np.zeros(0), 1e-6) == robust_std(np.zeros(7), 1e-6) == 1e-6

"""Regression with an intercept a group, against NumPy's least squares with a column for each."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from endotwin.pixels.fixed_effects import (
    DENSE,
    Design,
    FixedEffects,
    Left,
    regress,
    robust_losses,
    without_means,
)


def made(count: int, groups: int, categories: int) -> tuple[np.ndarray, Design]:
    """Values of which columns, groups and categories explain all but noise."""
    random = np.random.default_rng(count)
    columns = random.normal(size=(count, 3))
    group = np.r_[np.arange(groups), random.integers(0, groups, count - groups)]
    category = random.integers(0, categories, count)
    target = columns @ [1.0, -2.0, 0.5] + random.normal(size=groups)[group] + 0.1 * category
    target += 0.1 * random.normal(size=count)
    return target, Design(columns, group, groups, category, weight=random.uniform(0.5, 2, count))


@pytest.mark.parametrize(("count", "groups", "categories"), [(200, 10, 4), (1200, 400, 40)])
def test_a_round_is_least_squares_with_a_column_for_every_group_and_category(count, groups, categories):
    target, design = made(count, groups, categories)
    assert (groups * categories > DENSE * count) == (groups == 400)
    found = regress(target, design, categories, rounds=1)
    dummies = np.eye(groups)[design.group], np.eye(categories)[design.category][:, 1:]
    root = np.sqrt(design.weight)
    full = np.hstack([design.columns, *dummies]) * root[:, None]
    solved = np.linalg.lstsq(full, target * root)[0]
    np.testing.assert_allclose(found.coefficients, solved[:3], atol=1e-6)
    np.testing.assert_allclose(found.intercepts, np.r_[0, solved[3 + groups :]], atol=5e-5)  # by the ridge


def test_a_ridge_is_a_value_of_0_for_a_share_of_what_the_values_tell_of_a_coefficient():
    target, design = made(200, 10, 4)
    design = replace(design, category=None, ridge=np.array([0.0, 0.5, 0.0]))
    within = without_means(design.columns, design.weight, design.group, design.count)
    root = np.sqrt(design.weight)
    told = np.linalg.norm(within[:, 1] * root)
    rows = np.vstack([within * root[:, None], [0, np.sqrt(0.5) * told, 0]])
    found = regress(target, design, rounds=1).coefficients
    np.testing.assert_allclose(found, np.linalg.lstsq(rows, np.r_[target * root, 0])[0], atol=1e-6)
    assert abs(found[1]) < 0.7 * 2


@pytest.mark.parametrize("categories", [None, 4])
def test_what_other_columns_leave_is_what_a_regression_on_them_leaves(categories):
    target, design = made(1200, 40, 4)
    design = design if categories else replace(design, category=None)
    here = Left.of(target, design, 0.1, categories or 0)
    other = design.columns + 0.01 * np.random.default_rng(1).normal(size=(2, *design.columns.shape))
    left = [Left.of(target, replace(design, columns=x), 0.1, categories or 0).residuals for x in other]
    moved = np.stack(left, axis=1) - here.residuals[:, None]
    wrong = np.linalg.norm(here.beside(other) - here.residuals[:, None] - moved)
    assert wrong < 0.1 * np.linalg.norm(moved)


def test_a_value_that_other_columns_throw_far_off_hardly_pulls_the_rest():
    target, design = made(1200, 40, 4)
    here = Left.of(target, design, 0.1, 4)
    row = np.argmin(np.abs(here.residuals))
    far, near = np.stack([design.columns] * 2)
    far[row] += 1e3
    near[row] += 0.5
    moved = here.beside(np.stack([far, near])) - here.residuals[:, None]
    rest = np.abs(moved[design.group != design.group[row]]).max(axis=0)
    assert moved[row, 0] > 50
    assert 0 < rest[0] < 1.01 * rest[1]


def test_coefficients_that_are_not_below_0_are_those_of_bounded_least_squares():
    target, design = made(200, 10, 4)
    dummies = np.eye(10)[design.group], np.eye(4)[design.category][:, 1:]
    root = np.sqrt(design.weight)
    full, low = np.hstack([design.columns, *dummies]) * root[:, None], np.full(16, -np.inf)
    low[:2] = 0
    solved = lsq_linear(full, target * root, (low, np.inf)).x
    assert solved[1] == pytest.approx(0, abs=1e-6)
    found = regress(target, replace(design, positive=2), 4, rounds=1)
    np.testing.assert_allclose(found.coefficients, solved[:3], atol=1e-5)
    np.testing.assert_allclose(found.intercepts, np.r_[0, solved[13:]], atol=5e-5)


def test_outliers_bend_a_robust_regression_by_less_than_their_share():
    target, design = made(2000, 20, 3)
    target[::20] += 50
    np.testing.assert_allclose(regress(target, design, 3).coefficients, [1.0, -2.0, 0.5], atol=0.02)


def test_variation_within_groups_has_no_weighted_mean():
    _, design = made(200, 10, 4)
    within = without_means(design.columns, design.weight, design.group, design.count)
    sums = [np.bincount(design.group, design.weight * column, design.count) for column in within.T]
    np.testing.assert_allclose(sums, 0, atol=1e-12)


def test_a_value_of_weight_4_loses_as_much_as_four_of_weight_1():
    target, design = made(200, 10, 4)
    weight = np.random.default_rng(1).integers(1, 5, len(target))
    found = FixedEffects(np.array([0.9, -1.8, 0.4]), np.zeros(1), 0.0)
    weighed = replace(design, category=None, weight=weight.astype(float))
    each = np.repeat(np.arange(len(target)), weight)
    repeated = replace(weighed, weight=None)[each]
    wide = 1e3 * np.ptp(target)  # where losses are squares
    lost = robust_losses(target, weighed, found, wide).sum()
    assert lost == pytest.approx(robust_losses(target[each], repeated, found, wide).sum(), rel=1e-5)
    assert lost > 1.1 * robust_losses(target, replace(weighed, weight=None), found, wide).sum()

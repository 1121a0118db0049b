"""Anderson mixing against fixed points that are known."""

import numpy as np
import pytest

from endotwin.fit.mixing import DEPTH, Mixing


def settled(matrix: np.ndarray, start: np.ndarray, rounds: int) -> np.ndarray:
    """Where x ← 1 + matrix·(x − 1) is after so many rounds, mixed."""
    mixing, point = Mixing(), start
    for _ in range(rounds):
        point = mixing.mixed(point, 1 + matrix @ (point - 1))
    return point


@pytest.mark.parametrize("seed", range(8))
def test_a_linear_map_of_as_many_directions_as_are_remembered_is_at_its_fixed_point_at_once(seed):
    generator = np.random.default_rng(seed)
    vectors = generator.normal(size=(DEPTH, DEPTH))
    factors = np.array([0.95, -0.9, 0.5])
    matrix = vectors @ np.diag(factors) @ np.linalg.inv(vectors)
    np.testing.assert_allclose(settled(matrix, generator.normal(size=DEPTH), DEPTH + 2), 1, atol=1e-5)


def test_a_map_that_swings_ever_farther_settles():
    matrix = np.diag([-1.5, 0.2])
    plain = np.array([3.0, 3.0])
    for _ in range(6):
        plain = 1 + matrix @ (plain - 1)
    assert np.abs(plain - 1).max() > 10
    np.testing.assert_allclose(settled(matrix, np.array([3.0, 3.0]), 6), 1, atol=1e-6)


def test_the_first_step_is_the_plain_one_and_a_fixed_point_stays():
    mixing, image = Mixing(), np.array([2.0, 3.0])
    np.testing.assert_array_equal(mixing.mixed(np.zeros(2), image), image)
    for _ in range(3):
        np.testing.assert_array_equal(mixing.mixed(image, image), image)

"""The unit of length: 1 for a colon, and beyond it as continuous as powers of two can be."""

from types import SimpleNamespace

import numpy as np
import pytest

from endotwin.pixels.length_unit import COLON_MM, TYPICAL_MM, unit_mm


def unit_from(distance_mm: float) -> float:
    return unit_mm(SimpleNamespace(nearest_mm=np.array([distance_mm]), seen_by=np.ones(1)))


@pytest.mark.parametrize("distance_mm", [*COLON_MM, 12.0, TYPICAL_MM, 50.0])
def test_lengths_of_a_colon_are_millimetres(distance_mm):
    assert unit_from(distance_mm) == 1


def test_no_step_is_larger_than_a_factor_of_two():
    distances_mm = np.geomspace(1e-3, 1e5, 20_000)
    units = np.array([unit_from(distance_mm) for distance_mm in distances_mm])
    assert set(units[1:] / units[:-1]) == {1.0, 2.0}
    relative = units / (distances_mm / TYPICAL_MM)
    assert relative.max() <= TYPICAL_MM / COLON_MM[0] and relative.min() >= TYPICAL_MM / COLON_MM[1]


def test_a_surface_that_nothing_saw_has_the_unit_of_a_colon():
    assert unit_mm(SimpleNamespace(nearest_mm=np.full(3, np.inf), seen_by=np.zeros(3))) == 1

"""The least-squares solver's own promises; what it finds is tested in test_fit."""

from dataclasses import replace

import pytest

from endotwin.fit.gauss_newton import GLOBAL_RANGE, unusual
from endotwin.fit.model import Globals
from endotwin.twin import Light, Response


def ended_at(gamma: float, n: float, q: float) -> list[str]:
    return unusual(Globals.of(Light(10.0, n, q), Response(gamma), 0.04))


@pytest.mark.parametrize("index, name", [(1, "n"), (2, "q"), (3, "γ")])
@pytest.mark.parametrize("end", [0, 1])
def test_a_parameter_at_the_edge_of_its_range_is_told_with_what_is_usual(index, name, end):
    shared = Globals.of(Light(10.0, 2.0, 2.0), Response(0.45), 0.04)
    vector = shared.vector.clone()
    vector[index] = GLOBAL_RANGE[index][end] + 1e-4 * (1 - 2 * end)
    told = [words for words in unusual(replace(shared, vector=vector)) if words.startswith(f"{name} ")]
    assert len(told) == 1 and "edge of what is tried, usually" in told[0]


@pytest.mark.parametrize(
    "gamma, n, q", [(0.4545, 2.0, 2.0), (0.53, 1.9, 1.9), (0.246, 2.2, 2.9), (0.46, 0.6, 2.0)]
)
def test_what_endoscopes_have_is_not_remarked_upon(gamma, n, q):
    assert ended_at(gamma, n, q) == []


def test_more_than_three_standard_deviations_from_the_prior_are_told():
    assert ended_at(0.1507, 2.84, 3.12)[0].startswith("γ 0.151 (")
    assert ended_at(0.1542, 2.0, 2.0) == ["γ 0.154 (usually 0.155 to 0.755)"]
    assert ended_at(0.4545, 6.0, 2.0) == ["n 6.000 (usually 0.000 to 5.300)"]
    assert ended_at(0.4545, 2.0, 0.3) == ["q 0.300 (usually 0.350 to 3.650)"]

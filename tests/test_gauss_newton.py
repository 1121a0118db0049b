"""The least-squares solver's own promises; what it finds is tested in test_fit."""

from dataclasses import replace

import pytest
import torch

from endotwin.fit.gauss_newton import GLOBAL_RANGE, at_bounds
from endotwin.fit.model import Globals
from endotwin.twin import Light, Response


@pytest.mark.parametrize(("index", "name"), [(1, "n"), (2, "q"), (3, "gamma")])
@pytest.mark.parametrize("end", [0, 1])
def test_a_parameter_on_the_edge_of_its_range_is_named(index, name, end):
    inside = Globals.of(Light(10.0, 2.0, 2.0), Response(0.45), 0.04)
    vector = inside.vector.clone()
    vector[index] = GLOBAL_RANGE[index][end]
    beyond = torch.clamp(vector, *torch.tensor(GLOBAL_RANGE[: len(vector)], dtype=torch.float64).T)
    assert at_bounds(inside) == []
    assert at_bounds(replace(inside, vector=beyond)) == [name]

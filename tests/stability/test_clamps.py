"""Every clamp of the maths at its edge: values go on continuously, gradients stay finite."""

import math

import numpy as np
import pytest
import torch

from endotwin.fit.model import Globals
from endotwin.fit.state import COLOR_RANGE, State
from endotwin.light import shading
from endotwin.light.incidence import COS_MIN, DISTANCE_MIN_MM, incidence_on
from endotwin.surface.casting import Correspondences
from endotwin.twin import Light, Response


def around(edge: float, share: float = 1e-3) -> torch.Tensor:
    return torch.tensor(
        [edge * (1 - share), edge, edge * (1 + share)], dtype=torch.float64, requires_grad=True
    )


def test_roughness_below_its_least_is_its_least_and_above_it_changes_smoothly():
    roughness = around(shading.ROUGHNESS_MIN)
    cos, sin2 = torch.full((3,), 0.999, dtype=torch.float64), torch.full((3,), 0.002, dtype=torch.float64)
    lobe = shading.specular_colocated(cos, sin2, roughness)
    slope = torch.autograd.grad(lobe.sum(), roughness)[0]
    assert lobe[0] == lobe[1]
    assert float(lobe.detach()[2]) == pytest.approx(float(lobe.detach()[1]), rel=0.01)
    assert torch.isfinite(slope).all() and slope[0] == 0 and slope[2] != 0


def test_the_response_is_continuous_with_finite_slope_where_its_power_is_shifted():
    x = torch.tensor([0.0, 0.1, 1.0, 10.0]).double() * shading.RADIANCE_MIN
    x.requires_grad_()
    shown = shading.respond(x, 1 / 2.2)
    slope = torch.autograd.grad(shown.sum(), x)[0]
    assert shown[0] == 0 and (shown.diff() > 0).all() and (slope.diff() < 0).all()
    assert slope[0] == pytest.approx(shading.RADIANCE_MIN ** (1 / 2.2 - 1) / 2.2, rel=1e-9)


@pytest.mark.parametrize("distance_mm", [0.0, DISTANCE_MIN_MM / 2, DISTANCE_MIN_MM, 2 * DISTANCE_MIN_MM])
@pytest.mark.parametrize("cos", [-0.5, 0.0, COS_MIN / 2, COS_MIN, 2 * COS_MIN])
def test_grazing_averted_and_touching_hits_keep_finite_logarithms(cos, distance_mm):
    straight = np.array([[[0.0, 0.0, 1.0]]], np.float32)
    normals = np.array([[math.sqrt(1 - cos**2), 0, -cos]], np.float32)
    one = np.ones(1, np.float32)
    hits = Correspondences(np.zeros(1, np.int32), np.zeros(1, np.int32), one[:, None], distance_mm * one)
    seen = incidence_on(normals, hits, straight)
    assert seen.cos[0] == np.float32(max(cos, COS_MIN))
    assert seen.log_distance[0] == pytest.approx(math.log(max(distance_mm, DISTANCE_MIN_MM)), abs=1e-5)
    assert np.isfinite([seen.sin2[0], seen.log_cos_axis[0]]).all()


def test_base_colors_beyond_their_range_are_its_bounds_and_keep_a_slope_to_come_back_by():
    low, high = COLOR_RANGE
    shared = Globals.of(Light(30.0, 2.0, 2.0), Response(0.45), 0.04)
    raw = torch.tensor([[-1.0, low**0.45 / 2, low**0.45, 0.0], [high**0.45, 2.0, 9.0, 0.0]])
    state = State(None, raw, None, shared)
    color = state.materials[:, :3]
    assert float(color.min()) == pytest.approx(low, rel=1e-4) and float(color.max()) == pytest.approx(
        high, rel=1e-4
    )
    assert torch.isfinite(state.link_slope).all() and (state.link_slope > 0).all()

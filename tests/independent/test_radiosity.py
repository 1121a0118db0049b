"""Light between tissue and tissue against the integrating sphere."""

import numpy as np
import pytest

from independent.light import Lamp
from independent.radiosity import Radiosity
from independent.shapes import sphere


@pytest.mark.parametrize("albedo", [0.3, 0.8])
def test_a_sphere_is_an_integrating_sphere(albedo: float) -> None:
    """Each point of a sphere sees every other alike, so E_indirect = ρ/(1 − ρ)·mean(E_direct) everywhere."""
    wall = sphere(12)
    radiosity = Radiosity(wall, np.full((*wall.shape, 3), albedo), np.random.default_rng(0))
    direct = radiosity.direct(Lamp(L0=700, n=1.5, q=2), np.eye(4))[:, None]
    indirect = radiosity.bounce(direct, radiosity.tissue).arriving[..., 0]
    share = np.sqrt((wall.doubled_area**2).sum(axis=1))
    mean = (share * direct[radiosity.patch_of, 0]).sum() / share.sum()
    assert indirect.mean() == pytest.approx(albedo / (1 - albedo) * mean, rel=0.01)
    assert indirect.std() < 0.03 * indirect.mean()


def test_a_closed_wall_loses_no_light() -> None:
    wall = sphere(12)
    factors = Radiosity(wall, np.ones((*wall.shape, 3)), np.random.default_rng(0)).form_factors
    assert np.asarray(factors.sum(axis=1)).min() > 0.999


def test_a_lamp_at_the_centre_lights_half_a_sphere_evenly() -> None:
    """n = 0: E = L0/R² in front of the tip, 0 behind it."""
    wall = sphere(10)
    radiosity = Radiosity(wall, np.ones((*wall.shape, 3)), np.random.default_rng(0))
    direct = radiosity.direct(Lamp(L0=100, n=0, q=2), np.eye(4)).reshape(radiosity.shape)
    np.testing.assert_allclose(direct[4:], 1, rtol=0.01)
    assert not direct[:4].any()

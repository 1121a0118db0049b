"""Light between tissue and tissue against the integrating sphere."""

import numpy as np
import pytest

from independent.gloss import Gloss
from independent.light import Lamp
from independent.radiosity import Radiosity
from independent.shapes import sphere


@pytest.mark.parametrize("albedo", [0.3, 0.8])
def test_a_sphere_is_an_integrating_sphere(albedo: float) -> None:
    """Each point of a sphere sees every other alike, so E_indirect = ρ/(1 − ρ)·mean(E_direct) everywhere."""
    wall = sphere(12)
    radiosity = Radiosity(wall, np.full((*wall.shape, 3), albedo), np.random.default_rng(0))
    direct = radiosity.direct(Lamp(L0=700, n=1.5, q=2), np.eye(4))[:, None]
    nothing = np.zeros_like(direct)
    indirect = radiosity.bounce(direct, radiosity.tissue, nothing[:, 0], nothing).arriving[..., 0]
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


def test_what_facets_throw_on_is_the_light_times_their_directional_albedo() -> None:
    """From the centre all light of a sphere comes head on; none of what is mirrored is lost."""
    wall, roughness = sphere(12), 0.45
    radiosity = Radiosity(wall, np.ones((*wall.shape, 3)), np.random.default_rng(0))
    lamp, rough = Lamp(L0=700, n=1.5, q=2), np.full(len(radiosity.tissue), roughness)
    thrown = radiosity.mirrored(lamp, np.eye(4), rough, 0.04, np.random.default_rng(1)) @ radiosity.area_mm2
    arrived = radiosity.direct(lamp, np.eye(4)) @ radiosity.area_mm2
    share = Gloss(0.04).at(np.ones(1), np.full(1, roughness))[0]
    assert thrown == pytest.approx(share * arrived, rel=0.01)


def test_smooth_facets_throw_light_from_a_spheres_centre_across_it() -> None:
    wall, f0 = sphere(12), 0.04
    radiosity = Radiosity(wall, np.ones((*wall.shape, 3)), np.random.default_rng(0))
    lamp, smooth = Lamp(L0=700, n=4, q=2), np.full(len(radiosity.tissue), 0.1)
    found = radiosity.mirrored(lamp, np.eye(4), smooth, f0, np.random.default_rng(1)).reshape(radiosity.shape)
    direct = radiosity.direct(lamp, np.eye(4)).reshape(radiosity.shape)
    across = np.roll(direct[::-1], radiosity.shape[1] // 2, axis=1)
    np.testing.assert_allclose(found[:3].mean(axis=1), f0 * across[:3].mean(axis=1), rtol=0.1)
    assert found[5:].max() < 0.01 * found[:2].min()


def test_a_camera_at_a_spheres_centre_is_shown_the_other_side_by_smooth_facets() -> None:
    wall = sphere(12)
    radiosity = Radiosity(wall, np.ones((*wall.shape, 3)), np.random.default_rng(0))
    smooth = np.full(len(radiosity.tissue), 0.1)
    mixture = radiosity.shown(np.eye(4), [(0.04, 1.0, smooth)], np.random.default_rng(1))
    place_mm = radiosity._mean(radiosity._centres_mm)
    seen = np.flatnonzero(place_mm[:, 2] > 2)
    np.testing.assert_allclose(mixture.sum(axis=1)[seen], 1, rtol=1e-5)
    np.testing.assert_allclose((mixture @ place_mm)[seen], -place_mm[seen], atol=1.5)


def test_cameras_see_what_leaves_patches_but_for_what_lobes_make_of_the_lamps_light() -> None:
    """A sphere of albedo 0.5 whose patches show a camera the mixture of all that even light comes from."""
    wall = sphere(12)
    radiosity = Radiosity(wall, np.full((*wall.shape, 3), 0.5), np.random.default_rng(0))
    direct = radiosity.direct(Lamp(L0=700, n=1.5, q=2), np.eye(4))[:, None]
    gloss, nothing = np.full(len(direct), 0.03), np.zeros_like(direct)
    mixture = [radiosity.form_factors]
    found = radiosity.bounce(direct, radiosity.tissue, gloss, nothing, mixture)
    leaving = 0.5 * direct[:, 0] + 0.53 * found.arriving[0, ..., 0].ravel()
    np.testing.assert_allclose(found.shown[0, ..., 0].ravel(), mixture[0] @ leaving, rtol=1e-3)

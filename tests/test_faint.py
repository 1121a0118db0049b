"""Light and response beside effects that are too faint to be decided."""

from dataclasses import replace

import numpy as np
import pytest
import tube_twin
from scipy.spatial.transform import Rotation

from endotwin.effects import Effects
from endotwin.effects.offset import Offset
from endotwin.effects.specular import Specular
from endotwin.effects.vignetting import Vignetting
from endotwin.fit.faint import ASIDE_MM, MOST, NOTHING, VIGNETTING, Faint
from endotwin.fit.gauss_newton import GaussNewton
from endotwin.fit.light_stage import STEPS
from endotwin.fit.lighting import Relighting
from endotwin.fit.model import at_pixels
from endotwin.fit.within import Within
from endotwin.light.guides import AT_LENS, COSINE, guided
from endotwin.pixels.start import PRIOR
from endotwin.surface.casting import Caster

NONE = Effects([Specular()])


def photos(*effects) -> tuple:
    """The tube's twin with such effects, and photos of it on the way through."""
    twin = tube_twin.fitted(tube_twin.seen(tube_twin.surface()))
    materials = replace(twin.materials, metallic=0 * twin.materials.metallic)
    twin = replace(twin, materials=materials, effects=Effects([Specular(), *effects]))
    return twin, tube_twin.photographed(twin, tube_twin.CAMERA, np.stack(list(wandering())))


def wandering(count: int = 16):
    """Poses [4, 4] off the axis, turned this way and that: on it, all shapes follow the distance."""
    generator = np.random.default_rng(0)
    for s in np.linspace(0.15, 0.9, count):
        T_world_camera = tube_twin.pose(s)
        turn = Rotation.from_rotvec(generator.uniform(-0.6, 0.6, 3)).as_matrix()
        aside_mm = T_world_camera[:3, :2] @ generator.uniform(-4, 4, 2)
        T_world_camera[:3] = np.c_[T_world_camera[:3, :3] @ turn, T_world_camera[:3, 3] + aside_mm]
        yield T_world_camera


@pytest.fixture(scope="module")
def plain():
    return photos()


def irradiance(samples, surface, guides_mm) -> np.ndarray:
    """Of guides at ``guides_mm`` [K, 3] together, with L0 = 1 and the usual n and q, [N]."""
    lit = guided(samples.points_mm, samples.normals(surface), np.array(guides_mm, np.float32), COSINE)
    light = lit.cos_i * (PRIOR["n"] * lit.log_axis - PRIOR["q"] * lit.log_distance).exp()
    return light.double().mean(dim=1).numpy()


@pytest.mark.parametrize(
    "guides_mm, coefficients",
    [
        ([(0.02, 0, 0)], [0.02, 0, 0]),
        ([(0, -0.02, 0)], [0, -0.02, 0]),
        ([(0.3, 0, 0), (-0.3, 0, 0), (0, 0.3, 0), (0, -0.3, 0)], [0, 0, 0.3**2 / ASIDE_MM]),
    ],
)
def test_guides_beside_the_lens_change_the_light_as_the_shapes_say(plain, guides_mm, coefficients):
    twin, samples = plain
    samples = samples[(samples.log_distance.exp() > 2 * ASIDE_MM) & (samples.cos > 0.15)]
    faint = Faint.beside(NONE, {"vignetting": "off"}, samples, twin.surface)
    found = faint.shapes(samples) @ coefficients / ASIDE_MM
    lens, aside = (irradiance(samples, twin.surface, each) for each in (AT_LENS, guides_mm))
    exact = np.log(aside / lens)
    np.testing.assert_allclose(found, exact - exact.mean(), atol=0.02 * np.abs(exact).max())


def test_vignetting_is_a_shape_and_what_is_on_or_forced_off_is_none(plain):
    twin, samples = plain
    vignetting = Vignetting(k2=-VIGNETTING)
    faint = Faint.beside(NONE, {"offset": "off"}, samples, twin.surface)
    found = faint.with_more(np.array([-1.0])).log_exposure(samples)
    exact = np.log(vignetting.transmission(samples.views.camera, samples.pixel.numpy()))
    np.testing.assert_allclose(found, exact - exact.mean(), atol=1e-5)
    both = NONE.including(vignetting).including(Offset(((2.0, 0.0, 0.0),)))
    for effects, wanted in ((both, {}), (NONE, {"vignetting": "off", "offset": "off"})):
        none = Faint.beside(effects, wanted, samples, twin.surface)
        assert none.shapes(samples).shape == (len(samples), 0)
        assert not none.log_exposure(samples).any()


@pytest.mark.parametrize("gamma", [0.3, 1 / 2.2])
def test_what_changes_middle_grey_by_less_than_a_level_does_not_show(plain, gamma):
    twin, samples = plain
    faint = Faint.beside(NONE, {"offset": "off"}, samples, twin.surface)
    one = 1 / float(faint.with_more(np.ones(1)).log_exposure(samples).std())
    grey = 0.5 ** (1 / gamma)
    for levels in (0.9, 1.1):
        brighter = grey * np.exp(levels * np.log1p(2 / 255) / gamma)
        assert brighter**gamma - 0.5 == pytest.approx(levels / 255, rel=0.01)
        found = faint.with_more(np.array([one * levels * np.log1p(2 / 255) / gamma]))
        assert found.shows(samples, gamma) == (levels > 1)


@pytest.mark.parametrize("scale", [1e-30, 1e-3, 1e3, 1e30])
def test_points_at_the_lens_and_far_away_get_a_finite_factor(plain, scale):
    twin, samples = plain
    samples = replace(samples, log_distance=samples.log_distance + float(np.log(scale)))
    faint = Faint.beside(NONE, {}, samples, twin.surface)
    found = faint.with_more(np.array([3.0, -3.0, 3.0, 3.0])).log_exposure(samples)
    assert np.isfinite(found).all() and np.abs(found).max() <= MOST


ONE = Offset(((1.0, 0.0, 0.0),))
AROUND = Offset(((2.5, 0.0, 0.0), (-1.25, 2.165, 0.0), (-1.25, -2.165, 0.0)))


@pytest.mark.slow
@pytest.mark.parametrize("guides", [ONE, AROUND])
def test_guides_that_are_too_faint_to_be_decided_do_not_bend_the_response(guides):
    twin, samples = photos(guides)
    without, beside = (found(twin, samples, faint) for faint in (False, True))
    assert abs(beside / twin.response.gamma - 1) < 0.015
    assert abs(without / twin.response.gamma - 1) > 0.03


@pytest.mark.slow
def test_where_nothing_faint_is_there_the_response_is_as_well_told_beside_it(plain):
    twin, samples = plain
    assert found(twin, samples, True) == pytest.approx(twin.response.gamma, rel=0.002)


def found(twin, samples, faint: bool) -> float:
    """γ by what varies under a light at the lens, from where it is right."""
    surface, state = twin.surface, tube_twin.state_of(twin)
    beside = Faint.beside(NONE, {}, samples, surface) if faint else NOTHING
    relighting = Relighting(surface, Caster(surface), NONE, samples.views, beside)
    solver = GaussNewton(samples, surface.triangles, state.operator)
    material, shared = at_pixels(samples, solver.triangles, state.materials), state.shared
    for _ in range(STEPS):
        within = Within.of(solver.samples, surface, 1.0)
        moved = within.renewed(material, shared, (), 1 / 255, relighting.varied)
        relighting.vary(solver, moved)
        shared = moved.shared
    return shared.gamma

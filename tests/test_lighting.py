"""Training pixels under the effects that the fit has found so far."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import tube_twin

from endotwin.effects import Effects
from endotwin.effects.gain import Gain
from endotwin.effects.interreflection import Interreflection
from endotwin.effects.offset import Offset
from endotwin.effects.shadows import Shadows
from endotwin.effects.specular import Specular
from endotwin.fit.gauss_newton import GaussNewton, recolored
from endotwin.fit.lighting import Asked, Relighting, lit
from endotwin.fit.model import Globals, at_pixels, predict
from endotwin.fit.within import Within
from endotwin.surface.casting import Caster

LOG_GAIN = np.array([-0.2, 0.1, 0.25, -0.15, 0.0])


@pytest.fixture(scope="module")
def exposed_unevenly():
    """Photos of the tube in frames of different gain, and the state of a fit that has found the tube."""
    twin = tube_twin.fitted(tube_twin.seen(tube_twin.surface(fold_mm=2.0)))
    twin = replace(twin, materials=replace(twin.materials, metallic=0 * twin.materials.metallic))
    poses = np.stack([tube_twin.pose(s) for s in np.linspace(0.3, 0.7, len(LOG_GAIN))])
    samples = tube_twin.photographed(twin, tube_twin.CAMERA, poses)
    factor = np.exp(LOG_GAIN[samples.frame.numpy()] * twin.response.gamma)[:, None]
    color = np.uint8(np.clip(samples.color.numpy() * factor, 0, 255) + 0.5)
    return twin, replace(samples, color=torch.from_numpy(color)), tube_twin.state_of(twin)


@pytest.mark.parametrize("known", [(0, 1, 2, 3, 4), (1, 3), (2,)])
def test_the_detail_begins_with_the_gains_that_the_fit_finds_of_all_frames(exposed_unevenly, known):
    """Also where the probe was wrong about some frames, and looked at only some."""
    twin, samples, state = exposed_unevenly
    effects = Effects([Gain(known, (0.0,) * len(known))])
    relighting = Relighting(twin.surface, Caster(twin.surface), effects, samples.views)
    samples = lit(samples, twin.surface, Caster(twin.surface), relighting.effects)
    solver = GaussNewton(samples, twin.surface.triangles, state.operator)
    assert not state.table.any()
    for _ in range(3):
        relighting(solver, state)
    gain = relighting.effects["gain"]
    assert gain.frames == (0, 1, 2, 3, 4)
    np.testing.assert_allclose(gain.log_gain, LOG_GAIN, atol=0.01)
    shown = gain.of(samples.frame.numpy())
    np.testing.assert_allclose(solver.samples.log_exposure.exp(), shown, rtol=1e-6)


def test_a_frame_that_is_all_black_gets_a_gain_that_is_finite_and_leaves_the_others_theirs(exposed_unevenly):
    twin, samples, state = exposed_unevenly
    effects = Effects([Gain((0, 1, 2, 3, 4), (0.0,) * 5)])
    relighting = Relighting(twin.surface, Caster(twin.surface), effects, samples.views)
    black = torch.where((samples.frame == 4)[:, None], 0, samples.color)
    samples = lit(replace(samples, color=black), twin.surface, Caster(twin.surface), relighting.effects)
    solver = GaussNewton(samples, twin.surface.triangles, state.operator)
    for _ in range(12):
        relighting(solver, state)
    log_gain = np.asarray(relighting.effects["gain"].log_gain)
    assert np.isfinite(log_gain).all() and log_gain[4] < -2
    np.testing.assert_allclose(np.diff(log_gain[:4]), np.diff(LOG_GAIN[:4]), atol=0.01)


@pytest.mark.slow
def test_a_guide_that_casts_no_shadow_is_found_behind_the_lens_from_a_millimetre_aside():
    true = ((2.0, -1.0, -0.8),)
    twin = tube_twin.fitted(tube_twin.seen(tube_twin.surface()))
    materials = replace(twin.materials, metallic=0 * twin.materials.metallic)
    twin = replace(twin, materials=materials, effects=Effects([Specular(), Offset(true)]))
    poses = np.stack([tube_twin.pose(s) for s in np.linspace(0.2, 0.8, 12)])
    samples = tube_twin.photographed(twin, tube_twin.CAMERA, poses)
    state, caster = tube_twin.state_of(twin), Caster(twin.surface)
    aside = Effects([Specular(), Offset(((1.3, -0.4, 0.0),))])
    relighting = Relighting(twin.surface, caster, aside, samples.views)
    samples = lit(samples, twin.surface, caster, aside)
    solver = GaussNewton(samples, twin.surface.triangles, state.operator)
    shared = replace(state.shared, vector=state.shared.vector * torch.tensor([1, 1.1, 0.95, 1.05, 1.0]))
    for _ in range(10):
        within = Within.of(solver.samples, twin.surface, 1.0)
        material = at_pixels(solver.samples, solver.triangles, state.materials)
        found = within.renewed(material, shared, (), 1 / 255, relighting.varied)
        relighting.vary(solver, found)
        shared = found.shared
    assert np.linalg.norm(np.subtract(relighting.effects.guides_mm, true)) < 0.1
    told = (twin.response.gamma, twin.light.n, twin.light.q)
    assert (shared.gamma, *shared.log_light[1:]) == pytest.approx(told, rel=0.03)


def test_where_no_pixel_is_clipped_guides_light_none_of_them(exposed_unevenly):
    twin, samples, _ = exposed_unevenly
    effects = Effects([Specular(), Offset(((2.0, -1.0, 0.0),))])
    none = lit(samples[:0], twin.surface, Caster(twin.surface), effects)
    assert len(none) == len(none.guides) == 0


def test_guides_that_cast_shadows_stay_where_those_told():
    twin = tube_twin.fitted(tube_twin.seen(tube_twin.surface()))
    effects = Effects([Specular(), Offset(((2.0, -1.0, 0.0),)), Shadows()])
    samples = tube_twin.photographed(twin, tube_twin.CAMERA, tube_twin.pose(0.5)[None])
    assert Relighting(twin.surface, Caster(twin.surface), effects, samples.views).varied.guides == 0


def tissue_under(bounced_off: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """Albedo that shows ``photo`` in a white sphere lit with 1, beside the light that bounces off albedo
    ``bounced_off``: ρ + ρ² + … of it (Ulbricht's integrating sphere)."""
    return photo * (1 - bounced_off)


def test_bright_tissue_and_the_light_that_it_throws_settle_where_they_agree():
    """Each found beside the last of the other, they swing ever wider."""
    albedo = np.array([0.9, 0.6, 0.2])
    photo = albedo / (1 - albedo)
    calm = swinging = np.array([0.8, 0.5, 0.3])
    for _ in range(12):
        light, by_color, found = (
            calm / (1 - calm),
            1 / (1 - calm),
            np.minimum(tissue_under(calm, photo), 0.95),
        )
        asked = Asked(None, np.log(light), share=calm, by_color=by_color)
        light = np.exp(asked.settled(np.log(found / (1 - found)))[0])
        calm = light / (1 + light)
        swinging = np.clip(tissue_under(swinging, photo), 0, 0.99)
    np.testing.assert_allclose(calm, albedo, rtol=1e-3)
    assert np.abs(swinging - albedo)[0] > 0.3


@pytest.mark.slow
def test_colours_at_rest_throw_the_light_beside_which_they_were_found():
    """A step has changed the tube's colours, brighter on one side, beside the light that they threw before:
    so the photos look then, and so they are to look by the light of the colours themselves."""
    twin = tube_twin.fitted(tube_twin.seen(tube_twin.surface(fold_mm=2.0)))
    effects = Effects([Specular(), Interreflection(cell_mm=2.0)])
    poses = np.stack([tube_twin.pose(s) for s in np.linspace(0.3, 0.7, 4)])
    samples = tube_twin.photographed(twin, tube_twin.CAMERA, poses)
    state = tube_twin.state_of(
        replace(twin, materials=replace(twin.materials, metallic=0 * twin.materials.metallic))
    )
    shared = Globals.of(twin.light, twin.response, twin.materials.f0, bounce=True)
    state = replace(state, shared=shared)
    relighting = Relighting(twin.surface, Caster(twin.surface), effects, samples.views)
    solver = GaussNewton(samples, twin.surface.triangles, state.operator)
    relighting(solver, state)

    def shown(samples, state):
        return predict(samples, at_pixels(samples, solver.triangles, state.materials), state.shared)

    side = torch.from_numpy(np.tanh(twin.surface.vertices_mm[:, :1] / 5))
    stepped = recolored(state, (0.1 * side + torch.tensor([0.15, 0.1, 0.05])).float())
    relighting.asked(solver, stepped)
    wanted = shown(solver.samples, stepped)
    own = shown(relighting.relit(solver.samples, solver.triangles, stepped), stepped) - wanted
    rested = relighting.at_rest(solver, stepped)
    left = shown(relighting.relit(solver.samples, solver.triangles, rested), rested) - wanted
    assert left.square().mean().sqrt() < 0.2 * own.square().mean().sqrt()

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
from endotwin.fit.gauss_newton import GaussNewton
from endotwin.fit.light_stage import MOVES
from endotwin.fit.lighting import Bouncer, Relighting, lit
from endotwin.fit.model import GLOBALS, Globals, at_pixels, glow
from endotwin.fit.within import Within
from endotwin.light.bounced import Bounce
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
@pytest.mark.parametrize(("cast", "within_mm"), [((), 0.1), ((Shadows(),), 0.2)])
def test_a_guide_is_found_behind_the_lens_from_a_millimetre_aside(cast, within_mm):
    true = ((2.0, -1.0, -0.8),)
    twin = tube_twin.fitted(tube_twin.seen(tube_twin.surface()))
    materials = replace(twin.materials, metallic=0 * twin.materials.metallic)
    twin = replace(twin, materials=materials, effects=Effects([Specular(), Offset(true), *cast]))
    poses = np.stack([tube_twin.pose(s) for s in np.linspace(0.2, 0.8, 12)])
    samples = tube_twin.photographed(twin, tube_twin.CAMERA, poses)
    state, caster = tube_twin.state_of(twin), Caster(twin.surface)
    aside = Effects([Specular(), Offset(((1.3, -0.4, 0.0),)), *cast])
    relighting = Relighting(twin.surface, caster, aside, samples.views)
    samples = lit(samples, twin.surface, caster, aside)
    solver = GaussNewton(samples, twin.surface.triangles, state.operator)
    shared = replace(state.shared, vector=state.shared.vector * torch.tensor([1, 1.1, 0.95, 1.05, 1.0]))
    for _ in range(MOVES):
        within = Within.of(solver.samples, twin.surface, 1.0)
        material = at_pixels(solver.samples, solver.triangles, state.materials)
        found = within.moved(material, shared, (), 1 / 255, relighting.moving)
        relighting.move_guides(solver, found.aside_mm, state)
        shared = found.shared
    assert np.linalg.norm(np.subtract(relighting.effects.guides_mm, true)) < within_mm
    told = (twin.response.gamma, twin.light.n, twin.light.q)
    assert (shared.gamma, *shared.log_light[1:]) == pytest.approx(told, rel=0.03)


def test_where_no_pixel_is_clipped_guides_light_none_of_them(exposed_unevenly):
    twin, samples, _ = exposed_unevenly
    effects = Effects([Specular(), Offset(((2.0, -1.0, 0.0),))])
    none = lit(samples[:0], twin.surface, Caster(twin.surface), effects)
    assert len(none) == len(none.guides) == 0


class Interrupted(Bouncer):
    """Lets ``meanwhile`` be done once, as soon as it has noted anything, as another thread may."""

    meanwhile = None

    def __setattr__(self, name, value):
        super().__setattr__(name, value)
        if name != "meanwhile" and self.meanwhile is not None:
            meanwhile, self.meanwhile = self.meanwhile, None
            meanwhile()


def test_a_photo_that_is_lit_while_another_is_gets_the_light_that_it_gets_alone(exposed_unevenly):
    twin, samples, state = exposed_unevenly
    shared = Globals.of(twin.light, twin.response, 0.04, bounce=True)
    effects = Effects([Specular(), Interreflection(2.0)])
    triangles = torch.from_numpy(twin.surface.triangles.astype(np.int64))
    one, other = (samples[samples.frame == frame] for frame in samples.views.frames[:2])
    assert len(one) != len(other)
    bouncer = Interrupted(twin.surface, Caster(twin.surface), effects, samples.views)

    def bounced(photo):
        roughness = at_pixels(photo, triangles, state.materials[:, 3:])[:, 0]
        return bouncer.bounced(photo, roughness, state.materials, triangles, shared).bounce.log

    alone = bounced(one)
    bounced(other)
    bouncer.meanwhile = lambda: bounced(other)
    torch.testing.assert_close(bounced(one), alone)
    assert bouncer.meanwhile is None


@pytest.mark.parametrize("name", ["ln f0", "ln albedo scale"])
def test_how_glow_grows_with_the_white_lobe_is_known_before_light_is_cast_again(exposed_unevenly, name):
    twin, samples, state = exposed_unevenly
    shared = Globals.of(twin.light, twin.response, 0.04, bounce=True)
    more = 0.2 * torch.tensor([each == name for each in (*GLOBALS, "ln albedo scale")])
    brighter = replace(shared, vector=shared.vector + more)
    effects = Effects([Specular(), Interreflection(2.0)])
    relighting = Relighting(twin.surface, Caster(twin.surface), effects, samples.views)
    triangles = torch.from_numpy(twin.surface.triangles.astype(np.int64))
    material = at_pixels(samples, triangles, state.materials)
    here, there = (
        relighting.bounced(samples, triangles, replace(state, shared=each)) for each in (shared, brighter)
    )
    before, told, true = (
        glow(lit, material, each) for lit, each in ((here, shared), (here, brighter), (there, brighter))
    )
    assert (true > before).all()
    grown = (told - before).sum(dim=0) / (true - before).sum(dim=0)
    torch.testing.assert_close(grown, torch.ones(3), rtol=0.15, atol=0)


@pytest.mark.parametrize("alike", [True, False])
def test_bright_tissue_and_the_light_that_it_throws_settle_where_they_agree(alike):
    """All tissue of a white sphere at once, lit with 1, beside ρ + ρ² + … (Ulbricht); or one place among
    tissue that stays. Each found beside the last light of the other, the sphere swings ever wider."""
    albedo, around = np.array([0.8, 0.6, 0.2]), np.array([0.7, 0.5, 0.3])
    photo = albedo / (1 - albedo) if alike else albedo / (1 - around)

    def settled(follows: bool) -> np.ndarray:
        found = np.array([0.77, 0.58, 0.25])
        for _ in range(15):
            thrower = found if alike else around
            light, by_scale = thrower / (1 - thrower), torch.from_numpy(1 / (1 - thrower))[None]
            shown = torch.log(torch.from_numpy(found))[None]
            bounce = Bounce(
                *[torch.zeros(1, 3)] * 3, by_scale, torch.zeros(1, 3), torch.zeros(1, 2), shown=shown
            )

            def lacking(log_color, light=light, bounce=bounce):
                factor = bounce.followed(torch.from_numpy(log_color)[None], 1.0).numpy()[0]
                return np.exp(log_color) * (1 + light * (factor if follows else 1)) - photo

            low, high = np.full(3, np.log(1e-3)), np.full(3, np.log(0.97))
            for _ in range(50):
                middle = (low + high) / 2
                over = lacking(middle) > 0
                low, high = np.where(over, low, middle), np.where(over, middle, high)
            found = np.exp(middle)
        return found

    np.testing.assert_allclose(settled(follows=True), albedo, rtol=0.01)
    if alike:
        assert np.abs(settled(follows=False) - albedo)[0] > 0.1


def test_light_follows_a_change_of_all_colours_in_full_and_of_one_place_in_half():
    albedo, more = torch.tensor([0.8, 0.6, 0.2]).double(), 1e-4
    color = torch.log(albedo)[None]
    bounce = Bounce(
        *[torch.zeros(1, 3)] * 3, 1 / (1 - albedo)[None], torch.zeros(1, 3), shown=color, tissue=color
    )
    changed = torch.exp(color + more)
    full = torch.log(changed / (1 - changed)) - torch.log(albedo / (1 - albedo))
    found = bounce.followed(color + more, 1.0, color[0] + more)
    torch.testing.assert_close(torch.log(found), full, rtol=1e-3, atol=0)
    torch.testing.assert_close(torch.log(bounce.followed(color + more, 1.0)), full / 2, rtol=1e-3, atol=0)

"""What the camera adds to a rendering."""

from dataclasses import replace

import numpy as np
import pytest
import tube_twin

from endotwin.effects import Effects, effect_class
from endotwin.errors import OptionError
from endotwin.render import Renderer
from endotwin.synth.photograph import photographed
from endotwin.synth.variation.switches import equipped


@pytest.fixture(scope="module")
def twin():
    return tube_twin.fitted(tube_twin.surface())


def taken(twin, T_world_camera, T_world_next, *effects, seed=0):
    renderer = Renderer(replace(twin, effects=Effects(effects)))
    view = renderer.view(T_world_camera)
    generator = np.random.default_rng(seed)
    return view, photographed(renderer, view, T_world_camera, T_world_next, generator)[0]


def test_a_twin_without_rendered_effects_is_shown_as_it_is(twin):
    here = tube_twin.pose(0.3)
    view, color = taken(twin, here, here)
    assert color is view.color


def test_noise_has_its_strength_and_follows_the_generator(twin):
    here = tube_twin.pose(0.3)
    noise = effect_class("noise")(read_noise=0.02, shot_noise=0.0)
    view, color = taken(twin, here, here, noise)
    clear = (view.color > 0.1) & (view.color < 0.9)
    assert np.std((color - view.color)[clear]) == pytest.approx(0.02, rel=0.05)
    np.testing.assert_array_equal(color, taken(twin, here, here, noise)[1])
    assert (color != taken(twin, here, here, noise, seed=1)[1]).any()


def test_motion_blurs_only_a_camera_that_moves(twin):
    here = tube_twin.pose(0.3)
    further = here @ np.array(
        [[np.cos(0.2), 0, np.sin(0.2), 0], [0, 1, 0, 0], [-np.sin(0.2), 0, np.cos(0.2), 0], [0, 0, 0, 1]]
    )
    blur = effect_class("motion_blur")(shutter=0.8)
    view, still = taken(twin, here, here, blur)
    _, moved = taken(twin, here, further, blur)
    np.testing.assert_allclose(still, view.color, atol=1e-6)
    detail = [np.abs(np.diff(image, axis=1)).mean() for image in (still, moved)]
    assert detail[1] < 0.9 * detail[0]


def test_an_effect_that_only_a_fit_finds_is_not_switched_on(twin):
    with pytest.raises(OptionError, match="a fit with its effect gain on"):
        equipped(twin, {"gain": "on"}, "centerline:frames=3")


def test_blur_needs_poses_that_follow_each_other(twin):
    with pytest.raises(OptionError, match="jitter"):
        equipped(twin, {"motion_blur": "on"}, "jitter:frames=3")


def test_effects_that_a_twin_has_can_be_switched_off(twin):
    coated = replace(twin, effects=Effects([effect_class("coat")()]))
    assert "coat" not in equipped(coated, {"coat": "off"}, "jitter:frames=3").effects

"""What is fitted away before an effect counts as shown, and what is not."""

from dataclasses import replace

import numpy as np
import pytest

from independent.lens import Lens
from independent.picture import Studio, displayed
from independent.scene import Scene
from independent.shown import Pixels, shown_levels, wrong_levels


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A small scene that recedes, without effects."""
    return replace(Scene.draw(1, only=()), lens=Lens.pinhole(120, 90, 100), frames=6)


@pytest.fixture(scope="module")
def pixels(scene: Scene) -> Pixels:
    return Pixels(Studio(scene))


def test_what_the_rest_of_a_model_can_say_is_not_shown(scene: Scene, pixels: Pixels) -> None:
    """A wrong γ or q, and an albedo of its own for each cell of the wall, leave nothing."""
    x = pixels.radiance(scene.effects)
    value = displayed(x, scene)
    slope, columns = pixels.unclipped(value), [np.log(x), pixels.log_distance]
    albedo = np.random.default_rng(0).normal(size=10**5)[pixels.cell]
    change = slope * (0.02 * columns[0] - 0.3 * columns[1] + 0.1 * albedo)
    assert pixels.left(change, value, columns) < 1e-6
    assert pixels.left(change, value, columns[:1]) > 1e-2


def test_noise_is_shown_but_for_what_the_cells_take_up(scene: Scene, pixels: Pixels) -> None:
    """White noise loses a degree of freedom a cell: its mean square falls by cells/pixels."""
    value = displayed(pixels.radiance(scene.effects), scene)
    noise = np.random.default_rng(0).normal(size=len(value))
    left = 1 - (pixels.cell.max() + 1) / len(value)
    assert pixels.left(noise, value, []) == pytest.approx(255 * np.sqrt(left), rel=0.02)


@pytest.mark.slow
def test_a_gain_shows_as_far_as_it_goes(scene: Scene) -> None:
    levels = []
    for gain in (1.0, 1.1, 1.21):
        studio = Studio(replace(scene, gain=gain).having(frozenset({"gain"})))
        levels.append(shown_levels(studio)["gain"]["levels"])
    assert levels[0] == pytest.approx(0, abs=1e-4)
    assert levels[2] == pytest.approx(2 * levels[1], rel=0.15)
    assert levels[1] > 0.3


@pytest.mark.slow
def test_a_gain_of_each_frame_makes_q_harder_to_tell(scene: Scene) -> None:
    """Whoever flies straight ahead nears all tissue at once, as a gain would show it."""
    plain = wrong_levels(Studio(scene))
    gained = wrong_levels(Studio(scene.having(frozenset({"gain"}))))
    assert gained["q"] < 0.8 * plain["q"]


@pytest.mark.slow
def test_a_tone_curve_shows_in_hues_more_than_in_brightness(scene: Scene) -> None:
    """Red and blue of a place lie at different places of the curve; and twice the contrast shows twice."""
    toned = replace(scene, tone=0.2).having(frozenset({"tone"}))
    levels = shown_levels(Studio(toned))["tone"]["levels"]
    more = shown_levels(Studio(replace(toned, tone=0.4)))["tone"]["levels"]
    assert more == pytest.approx(2 * levels, rel=0.15)
    grey = Pixels(Studio(toned))
    x = grey.radiance(frozenset())
    plain, columns = displayed(x, scene), [np.log(x), grey.log_axis, grey.log_distance]
    assert levels > 1.2 * grey.left(displayed(x, toned) - plain, plain, columns)

"""Which effects a fit finds in small scenes of the independent renderer."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import pytest
from independent.lens import Lens
from independent.scene import EFFECTS, Scene
from independent.write import make

import endotwin
from endotwin.effects import Decision
from endotwin.effects.coat import Coat
from endotwin.effects.tone import Tone
from endotwin.fit import light_stage
from endotwin.twin import Twin


@pytest.fixture(scope="module")
def find(tmp_path_factory) -> Callable[[int, set[str]], tuple[Twin, dict]]:
    """The fitted twin of a seed's scene with these effects, at 160×120, and the scene's truth."""

    @cache
    def fused(seed: int, effects: frozenset[str]) -> tuple[Twin, dict]:
        folder = tmp_path_factory.mktemp("scene")
        scene = replace(Scene.draw(seed).having(effects), lens=Lens.pinhole(160, 120, 100), frames=9)
        made = make(scene, folder)
        return endotwin.fuse_twin(folder), made

    def find(seed: int, effects: set[str]) -> tuple[Twin, dict]:
        twin, made = fused(seed, frozenset(effects))
        return endotwin.fit_twin(twin, align="off"), made

    return find


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "effects"),
    [
        pytest.param(12, {"gain"}, id="gain"),
        pytest.param(13, {"profile"}, id="profile", marks=pytest.mark.long),
    ],
)
def test_a_fit_finds_what_a_scene_has_and_nothing_else(find, seed: int, effects: set[str]) -> None:
    twin, made = find(seed, effects)
    assert {name for name in EFFECTS if twin.decisions[name].state == "on"} == effects
    assert all(shown["levels"] > 1 for shown in made["shown"].values())
    assert twin.response.gamma == pytest.approx(made["gamma"], rel=0.04)


@pytest.mark.long
@pytest.mark.parametrize(
    ("seed", "effects"),
    [(1725, {"offset", "shadows", "interreflection", "gain"}), (1741, {"interreflection", "tone"})],
)
def test_a_bounce_that_brightness_hides_is_told_by_hues(find, seed: int, effects: set[str]) -> None:
    twin, made = find(seed, effects)
    assert {name for name in EFFECTS if twin.decisions[name].state == "on"} == effects
    assert "hues" in twin.decisions["interreflection"].reason
    assert twin.response.gamma == pytest.approx(made["gamma"], rel=0.04)


@pytest.mark.long
def test_the_strength_of_a_bounce_off_pale_tissue_is_found(find) -> None:
    """The 98th percentile of its red is 0.85, not far below a furnace."""
    twin, made = find(237, {"interreflection"})
    assert twin.light.L0 / made["L0"] == pytest.approx(1, rel=0.1)
    assert twin.light.n == pytest.approx(made["n"], rel=0.1)
    assert twin.response.gamma == pytest.approx(made["gamma"], rel=0.03)
    assert endotwin.evaluate(twin).psnr_covered > 38


@pytest.mark.long
def test_a_response_that_no_display_has_is_found_where_light_bounces(find) -> None:
    """What the model errs by says how far photos are believed, and it is little here."""
    twin, made = find(177, {"interreflection"})
    assert made["gamma"] > 0.51
    assert twin.response.gamma == pytest.approx(made["gamma"], rel=0.04)


@pytest.mark.long
def test_a_haze_brighter_than_water_does_not_ruin_a_bounce(find, monkeypatch) -> None:
    """Whatever the highlights say: it passes for the tissue's own lobe, and sends on what falls on it."""
    said = Decision("on", "the highlights say so", 1.1)
    haze = Coat(weight=7.0, roughness=0.32, tail=1.0)
    monkeypatch.setattr(light_stage, "judged_coat", lambda highlights, wanted, tried: (haze, said))
    twin, made = find(224, {"interreflection"})
    assert "interreflection" in twin.effects and said.reason in twin.decisions["coat"].reason
    assert twin.response.gamma == pytest.approx(made["gamma"], rel=0.06)
    assert endotwin.evaluate(twin).psnr_covered > 37.5


@pytest.mark.long
def test_a_false_tone_curve_is_taken_back_where_all_pixels_bend_it_to_none(find, monkeypatch) -> None:
    said = Decision("on", "the hues say so", 1.1)
    monkeypatch.setattr(light_stage, "judged_tone", lambda hues, wanted: (Tone(0.4), said))
    twin, made = find(237, {"interreflection"})
    assert twin.decisions["tone"].state == "off" and said.reason in twin.decisions["tone"].reason
    assert "tone" not in twin.effects and "interreflection" in twin.effects
    assert twin.response.gamma == pytest.approx(made["gamma"], rel=0.05)
    assert endotwin.evaluate(twin).psnr_covered > 37

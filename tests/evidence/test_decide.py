"""Which effects are called for, on sequences that an independent path tracer made."""

import os
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from independent.scene import Scene
from independent.write import make

from endotwin.config import STANDARD
from endotwin.effects.vignetting import Vignetting
from endotwin.evidence.bounce import Patches, Surroundings
from endotwin.evidence.decide import _Trial, decide
from endotwin.evidence.glints import Glints
from endotwin.evidence.guide_search import Ground, _judged, _judged_another, found_guides
from endotwin.evidence.probe import Hypothesis, Probe
from endotwin.evidence.tint import Tints
from endotwin.evidence.verdict import Verdict
from endotwin.light.guides import AT_LENS
from endotwin.pipeline import fuse_twin
from endotwin.pixels.pace import Pace
from endotwin.pixels.samples import gather
from endotwin.pixels.start import LIGHT_MEAN, LIGHT_SPREAD, closed_form
from endotwin.surface.casting import Caster

pytestmark = pytest.mark.slow

EXAMPLE = Path(__file__).parents[2] / "examples" / "colon_small"
DATA = Path(os.environ.get("ENDOTWIN_DATA", "nowhere"))
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="ENDOTWIN_DATA names no folder")
NOTHING = Verdict(0.0, 0.0)
LIGHT = ("offset", "shadows", "interreflection", "gain", "vignetting", "profile")


def scene(path: Path, scale: float):
    """A fused twin of the sequence, a caster of its mesh, the pixels that a fit would look at, and their
    glints."""
    twin = fuse_twin(path, scale=scale)
    caster = Caster(twin.surface)
    samples = gather(twin, Pace(STANDARD.fit), 0, caster)
    smooth = twin.surface.normal_agreement() > np.cos(np.radians(5))
    smooth = samples[torch.from_numpy(smooth[samples.triangle.numpy()])]
    telling = smooth[smooth.color.amax(dim=1) < 250]

    def glints() -> Glints:
        start = closed_form(telling, twin.surface.triangles, len(twin.surface.vertices_mm))
        return Glints.of(smooth, twin.surface, start)

    return twin, caster, telling, cache(glints)


@pytest.fixture(scope="module")
def example():
    return scene(EXAMPLE, 1.0)


def states(decided) -> dict[str, str]:
    return {name: decided.decisions[name].state for name in LIGHT}


def brightened(samples, log_gain: np.ndarray):
    """The samples as a camera of gamma 2.2 would have shown them with a gain of each frame."""
    frame = samples.frame.numpy()
    factor = np.exp(log_gain[frame] / 2.2)[:, None]
    color = np.clip(samples.color.numpy() * factor, 0, 255)
    return replace(samples, color=torch.from_numpy(np.uint8(color + 0.5)))


def test_a_scene_lit_as_in_the_paper_calls_for_no_effect(example):
    twin, caster, samples, glints = example
    assert set(states(decide(samples, twin, caster, glints, {})).values()) == {"off"}


def test_guides_that_are_known_beforehand_are_given_up_where_no_photo_shows_them(example):
    near_mm = ((-2.0, 0.5, 0.0), (2.0, 0.0, 0.0))
    decided = decide(*reordered(example), {}, near_mm=near_mm)
    assert decided.decisions["offset"].state == "off"
    assert decided.effects.guides_mm is None


def test_gain_is_found_to_a_hundredth(example):
    twin, caster, samples, glints = example
    log_gain = np.random.default_rng(3).normal(0, 0.15, 64)
    decided = decide(brightened(samples, log_gain), twin, caster, glints, {})
    assert states(decided) == {**dict.fromkeys(LIGHT, "off"), "gain": "on"}
    gain = decided.effects["gain"]
    true = log_gain[list(gain.frames)]
    assert np.abs(np.array(gain.log_gain) - (true - true.mean())).max() < 0.02


def test_an_effect_that_gains_little_is_not_kept_beside_a_light_that_no_endoscope_has(example):
    twin, caster, samples, _ = example
    log_gain = np.random.default_rng(3).normal(0, 0.02, 64)
    probe = Probe(brightened(samples, log_gain), twin, caster)
    plain, gained = probe.fit(Hypothesis()), probe.fit(Hypothesis(gain=True))
    assert probe.compare(plain, gained).keep
    towards_the_sides = replace(
        gained.effects, coefficients=gained.effects.coefficients * [-1, 1, 1, 1, 1, 1]
    )
    assert not probe.compare(plain, replace(gained, effects=towards_the_sides)).keep


def test_a_light_that_no_endoscope_has_is_no_place_to_start_a_fit_from(example):
    twin, caster, samples, _ = example
    found = Probe(samples, twin, caster).fit(Hypothesis(gain=True))
    assert found.start == (found.n, found.q, found.gamma)
    flat = replace(found, effects=replace(found.effects, coefficients=1e-9 * found.effects.coefficients))
    assert flat.start == (2.0, 2.0, 1 / 2.2)
    assert np.abs(flat.log_gain).max() < 2.2 * np.abs(found.effects.intercepts).max() + 1e-9


def test_a_profile_that_is_no_cosine_is_found(example):
    twin, caster, samples, glints = example
    cos_axis = samples.log_cos_axis.exp().numpy()
    factor = (np.exp(-4 * (1 - cos_axis)) / cos_axis**2) ** (1 / 2.2)
    color = np.uint8(np.clip(samples.color.numpy() * factor[:, None], 0, 255) + 0.5)
    decided = decide(replace(samples, color=torch.from_numpy(color)), twin, caster, glints, {})
    assert states(decided) == {**dict.fromkeys(LIGHT, "off"), "profile": "on"}
    n, _, _ = decided.start
    assert n == pytest.approx(4, rel=0.05)
    assert decided.effects["profile"].exponential == pytest.approx(1, abs=0.1)


@pytest.mark.long
def test_a_profile_forced_on_a_cosine_stays_one(example):
    twin, caster, samples, glints = example
    decided = decide(samples, twin, caster, glints, {"profile": "on"})
    assert states(decided) == {**dict.fromkeys(LIGHT, "off"), "profile": "on"}
    assert decided.effects["profile"].exponential == pytest.approx(0, abs=0.1)
    n, _, _ = decided.start
    assert n == pytest.approx(2, rel=0.05)


def test_guides_are_sought_beside_no_gain_that_is_not_worth_its_place(example, monkeypatch):
    """It would explain what guides throw, and hide them."""
    twin, caster, samples, glints = example
    log_gain = np.random.default_rng(3).normal(0, 0.005, 64)
    bases = []

    def found(ground, base, *_):
        bases.append(base)
        return AT_LENS

    monkeypatch.setattr("endotwin.evidence.decide.found_guides", found)
    decided = decide(brightened(samples, log_gain), twin, caster, glints, {})
    assert decided.decisions["gain"].state == "off" and decided.decisions["gain"].gain_db > 0
    assert bases and not any(base.gain for base in bases)


def test_guides_that_do_not_show_without_bounced_light_are_sought_beside_it(example, monkeypatch):
    twin, caster, samples, glints = example
    guides_mm, sets = ((2.0, 0.0, 0.0),), []

    def found(ground, base, *_):
        return AT_LENS if base.bounced is None else guides_mm

    fit = Probe.fit

    def fitted(probe, hypothesis):
        sets.append(hypothesis)
        return fit(probe, hypothesis)

    monkeypatch.setattr("endotwin.evidence.decide.found_guides", found)
    monkeypatch.setattr(Probe, "fit", fitted)
    monkeypatch.setattr(Tints, "still", NOTHING)
    decide(samples, twin, caster, glints, {})
    beside = [each for each in sets if each.guides_mm != AT_LENS]
    assert {each.bounced is None for each in beside} == {False, True}
    assert guides_mm in {each.guides_mm for each in beside if each.bounced is None}
    sets.clear()
    decide(samples, twin, caster, glints, {"interreflection": "off"})
    assert all(each.guides_mm == AT_LENS for each in sets)


def test_nothing_is_tried_with_a_bounce_that_hues_rule_out(example, monkeypatch):
    twin, caster, samples, glints = example
    tried = []

    def fitted(probe, hypothesis, fit=Probe.fit):
        tried.append(hypothesis)
        return fit(probe, hypothesis)

    monkeypatch.setattr(Probe, "fit", fitted)
    decision = decide(samples, twin, caster, glints, {}).decisions["interreflection"]
    assert tried and all(each.bounced is None for each in tried)
    assert decision.state == "off" and decision.gain_db < 0 and "hues" in decision.reason


def test_an_effect_that_is_forced_off_stays_off(example):
    twin, caster, samples, glints = example
    log_gain = np.random.default_rng(3).normal(0, 0.15, 64)
    decided = decide(brightened(samples, log_gain), twin, caster, glints, {"gain": "off"})
    assert decided.decisions["gain"].state == "off"
    assert decided.decisions["gain"].reason == "forced off"


@pytest.fixture(scope="module")
def bouncing():
    return scene(DATA / "colon_gi", 0.5)


@needs_data
def test_interreflection_turns_itself_on_in_a_tube_that_has_it(bouncing):
    decided = decide(*reordered(bouncing), {})
    assert states(decided) == {**dict.fromkeys(LIGHT, "off"), "interreflection": "on"}


@needs_data
def test_vignetting_is_told_from_the_profile_of_a_light_at_the_lens_by_what_bounces(bouncing):
    twin, caster, samples, glints = bouncing
    decided = decide(vignetted(samples, twin, Vignetting(-0.5)), twin, caster, glints, {})
    on = dict.fromkeys(("interreflection", "vignetting"), "on")
    assert states(decided) == {**dict.fromkeys(LIGHT, "off"), **on}
    assert decided.effects["vignetting"].k2 == pytest.approx(-0.5, abs=0.1)


@pytest.mark.long
def test_guides_that_stand_far_out_for_how_near_the_wall_is_are_found(tmp_path):
    """4 to 5 mm beside the lens, where the wall is seen from 15 mm."""
    made = make(replace(Scene.draw(54, ["offset"]), frames=8), tmp_path / "scene")
    twin, caster, samples, glints = scene(tmp_path / "scene", 0.5)
    found = found_guides(Ground(Probe(samples, twin, caster), glints()), Hypothesis(), forced=False)
    for true_mm in made["guides_mm"]:
        assert np.linalg.norm(np.subtract(found, true_mm), axis=1).min() < 0.7


@pytest.mark.long
def test_guides_two_millimetres_from_the_lens_are_found_where_no_light_bounces(tmp_path):
    """A tenth of a decibel off the highlights, and three with them."""
    made = make(Scene.draw(400).having(frozenset(("offset", "shadows", "coat"))), tmp_path)
    decided = decide(*reordered(scene(tmp_path, 1.0)), {})
    on = {name for name, state in states(decided).items() if state == "on"}
    assert "offset" in on and not on & {"interreflection", "gain"}
    for true_mm in made["guides_mm"]:
        apart_mm = np.linalg.norm(np.subtract(decided.effects["offset"].guides_mm, true_mm), axis=1)
        assert apart_mm.min() < 0.7


@pytest.mark.long
def test_a_guide_that_stands_elsewhere_beside_the_profile_it_has_is_found_there(tmp_path):
    """Beside a cosine the light of an exponential profile seems to come from 2.5 mm farther out."""
    made = make(Scene.draw(1700), tmp_path)
    decided = decide(*reordered(scene(tmp_path, 1.0)), {})
    assert {"offset", "profile"} <= set(decided.effects)
    assert decided.effects["profile"].exponential == pytest.approx(1, abs=0.1)
    np.testing.assert_allclose(decided.effects["offset"].guides_mm, made["guides_mm"], atol=0.3)


@pytest.fixture(scope="module")
def lit_from_beside():
    return scene(DATA / "colon_offset", 0.5)


GUIDES_MM = [[-2.5, 1.0, 0.0], [2.5, 0.0, 0.0]]


@needs_data
def test_guides_are_found_within_half_a_millimetre_with_their_shadows(lit_from_beside):
    decided = decide(*reordered(lit_from_beside), {})
    assert states(decided) == {**dict.fromkeys(LIGHT, "off"), "offset": "on", "shadows": "on"}
    np.testing.assert_allclose(sorted(decided.effects["offset"].guides_mm), GUIDES_MM, atol=0.5)


@pytest.mark.long
@needs_data
def test_guides_are_found_from_near_them_as_from_nowhere(lit_from_beside):
    near_mm = tuple(map(tuple, np.add(GUIDES_MM, [[0.6, -0.4, 0.0], [-0.5, 0.5, -0.3]])))
    decided = decide(*reordered(lit_from_beside), {}, near_mm=near_mm)
    np.testing.assert_allclose(sorted(decided.effects["offset"].guides_mm), GUIDES_MM, atol=0.5)


@needs_data
def test_shadows_are_cast_by_guides_unless_hardly_a_pixel_lies_in_one_or_many_contradict_them(
    lit_from_beside,
):
    twin, caster, samples, glints = lit_from_beside

    def state(samples, guides_mm) -> str:
        probe = Probe(samples, twin, caster)
        trial = _Trial(probe, lambda: Patches(probe), glints, {}, lambda: False, AT_LENS)
        trial.shadowed(probe.fit(Hypothesis(tuple(map(tuple, guides_mm)), shadows=True)))
        return trial._decisions["shadows"].state

    probe = Probe(samples, twin, caster)
    shaded = probe._rows[~probe.visible(GUIDES_MM).all(axis=1)]
    few = samples[torch.from_numpy(np.delete(np.arange(len(samples)), shaded[20:]))]
    assert state(samples, GUIDES_MM) == "on" and state(few, GUIDES_MM) == "on"
    assert state(samples, np.multiply(GUIDES_MM, [0.01, 0.01, 1])) == "off"
    assert state(samples, np.multiply(GUIDES_MM, 3)) == "off"


@needs_data
def test_guides_that_gain_little_beside_a_bounce_are_borne_out_by_shadows_that_show(lit_from_beside):
    twin, caster, samples, glints = lit_from_beside
    ground = Ground(Probe(samples, twin, caster), glints())

    def model(guides_mm, bounces: bool = True):
        light = Hypothesis(tuple(map(tuple, guides_mm)), shadows=True)
        bounced = Surroundings(ground.probe, Patches(ground.probe)).bounced(light) if bounces else None
        return ground.probe.fit(replace(light, bounced=bounced))

    there, nearly_at_lens = model(GUIDES_MM), model(np.multiply(GUIDES_MM, [0.01, 0.01, 1]))
    without_bounce = model(np.multiply(GUIDES_MM, [0.01, 0.01, 1]), bounces=False)
    assert ground.borne_out(there, Verdict(0.06, 5)) and not ground.borne_out(there, Verdict(0.04, 5))
    assert not ground.borne_out(nearly_at_lens, Verdict(0.3, 5))
    assert ground.borne_out(without_bounce, Verdict(0.3, 5))
    assert ground.borne_out(nearly_at_lens, Verdict(0.6, 5))
    assert ground.in_doubt(there, Verdict(0.01, 1.5)) and not ground.in_doubt(there, Verdict(-0.01, -1))
    assert not ground.in_doubt(nearly_at_lens, Verdict(0.01, 1.5))


@pytest.mark.parametrize(("judged", "stay"), [(_judged, 0), (_judged_another, 1)])
def test_guides_in_doubt_are_judged_where_all_pixels_say_that_they_are(example, monkeypatch, judged, stay):
    """Some pixels put them beside it, where they gain too little."""
    twin, caster, samples, glints = example
    ground = Ground(Probe(samples, twin, caster), glints())
    others = tuple((0.0, 2.0 + k, 0.0) for k in range(stay))
    rough, exact = (*others, (2.0, 0.0, 0.0)), (*others, (2.5, 0.0, 0.0))
    by_shadows = [2.0]

    def compared(probe, base, other) -> Verdict:
        return Verdict(0.25, 4) if exact == other.hypothesis.guides_mm else Verdict(0.15, 2.5)

    def polished(ground, model):
        found = model.hypothesis.guides_mm == rough
        return ground.probe.fit(replace(model.hypothesis, guides_mm=exact)) if found else model

    monkeypatch.setattr(Probe, "compare", compared)
    monkeypatch.setattr("endotwin.evidence.guide_search.polished", polished)
    monkeypatch.setattr(ground, "unshadowed", lambda model: (model, Verdict(0.1, by_shadows[0])))
    beside = ground.probe.fit(Hypothesis(others or AT_LENS, shadows=bool(others)))
    found = ground.probe.fit(Hypothesis(rough, shadows=True))
    better, model = judged(ground, beside, found)
    assert better and model.hypothesis.guides_mm == exact
    if judged is _judged:
        by_shadows[0] = -1.0
        assert judged(ground, beside, found) == (False, found)


@pytest.mark.parametrize(
    ("gain_db", "likelier", "state"),
    [(-0.05, 2.7, "on"), (-0.05, 1.0, "off"), (-0.5, 2.7, "off"), (0.15, -1.0, "on")],
)
def test_a_bounce_that_gains_make_up_for_is_told_by_how_usual_light_and_response_are_beside_it(
    example, monkeypatch, gain_db, likelier, state
):
    twin, caster, samples, glints = example

    def compared(probe, base, other) -> Verdict:
        more = (other.hypothesis.bounced is not None) - (base.hypothesis.bounced is not None)
        return Verdict(more * gain_db, more * np.sign(gain_db) * 5, likelier=more * likelier)

    monkeypatch.setattr(Probe, "compare", compared)
    monkeypatch.setattr(Tints, "still", NOTHING)
    wanted = {name: "off" for name in LIGHT if name != "interreflection"}
    probe = Probe(samples, twin, caster)
    trial = _Trial(probe, lambda: Patches(probe), glints, wanted, lambda: False, AT_LENS)
    trial.together()
    assert trial._decisions["interreflection"].state == state


@pytest.mark.parametrize(
    ("exponential_db", "vignetting_db", "first"),
    [(0.3, 0.4, "vignetting"), (0.4, 0.3, "profile"), (0.3, None, "profile")],
)
def test_of_profile_and_vignetting_the_one_that_explains_more_is_decided_first(
    example, monkeypatch, exponential_db, vignetting_db, first
):
    """Which may lose a place that it had only as long as the other was not tried."""
    twin, caster, samples, glints = example

    def compared(probe, base, other) -> Verdict:
        vignettes, brightens = other.hypothesis.vignetting, vignetting_db is None
        return Verdict(
            (vignetting_db or 1.0) if vignettes else exponential_db, 5, not (vignettes and brightens)
        )

    monkeypatch.setattr(Probe, "compare", compared)
    probe = Probe(samples, twin, caster)
    trial = _Trial(probe, lambda: Patches(probe), glints, {}, lambda: False, AT_LENS)
    kept = probe.fit(Hypothesis(((3.0, 0.0, 0.0),)))
    assert trial.stronger_first(kept)[0] == first


def test_light_and_response_are_as_unusual_as_they_are_far_from_what_is_usual(example):
    twin, caster, samples, _ = example
    found = Probe(samples, twin, caster).fit(Hypothesis())
    mean, spread = np.array(LIGHT_MEAN), np.array(LIGHT_SPREAD)
    for off, nats in (([0, 0, 0], 0.0), ([0, 0, 2], 2.0), ([1, -1, 1], 1.5)):
        coefficients = np.r_[mean + off * spread, found.effects.coefficients[3:]]
        moved = replace(found, effects=replace(found.effects, coefficients=coefficients))
        assert moved.unusual == pytest.approx(nats)


def test_no_light_is_likelier_that_no_endoscope_has(example):
    twin, caster, samples, _ = example
    probe = Probe(samples, twin, caster)
    found = probe.fit(Hypothesis())

    def with_gamma(gamma: float):
        coefficients = found.effects.coefficients.copy()
        coefficients[2] = gamma
        return replace(found, effects=replace(found.effects, coefficients=coefficients))

    unusual, *odd = map(with_gamma, (0.2, -0.6, -0.3))
    assert probe.compare(unusual, found).likelier > 2
    assert probe.compare(*odd).likelier == 0 < odd[0].unusual - odd[1].unusual


@pytest.mark.long
@needs_data
def test_vignetting_and_guides_are_told_apart(lit_from_beside):
    twin, caster, samples, glints = lit_from_beside
    true = Vignetting(-0.5, -0.1)
    decided = decide(vignetted(samples, twin, true), twin, caster, glints, {})
    on = dict.fromkeys(("offset", "shadows", "vignetting"), "on")
    assert states(decided) == {**dict.fromkeys(LIGHT, "off"), **on}
    np.testing.assert_allclose(sorted(decided.effects["offset"].guides_mm), GUIDES_MM, atol=0.5)
    # Cosines of the profile can stand in for k2, so that only what the two pass together is told.
    r2 = np.linspace(0, 1, 50)
    cosine = -np.log1p(r2 * (0.5 / 0.6) ** 2) / 2
    found = decided.effects["vignetting"]
    n, _, _ = decided.start
    passed = n * cosine + found.k2 * r2 + found.k4 * r2**2
    np.testing.assert_allclose(passed, cosine + true.k2 * r2 + true.k4 * r2**2, atol=0.03)


def vignetted(samples, twin, vignetting: Vignetting):
    """The samples as a lens with ``vignetting`` and a camera of gamma 2.2 would have shown them."""
    passed = vignetting.transmission(twin.camera, samples.pixel.numpy()) ** (1 / 2.2)
    return replace(samples, color=torch.from_numpy(np.uint8(samples.color.numpy() * passed[:, None] + 0.5)))


def reordered(made):
    twin, caster, samples, glints = made
    return samples, twin, caster, glints

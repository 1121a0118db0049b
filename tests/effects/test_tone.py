"""The tone curve against closed forms, and what hues say of it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from endotwin.effects.tone import Tone, bend
from endotwin.evidence import tone as evidence
from endotwin.evidence.tone import LEAST_CONTRAST, Hues, judged, steadied
from endotwin.evidence.verdict import Verdict

CONTRASTS = st.floats(0, 0.9)
RAMP = torch.linspace(0, 1.3, 1301, dtype=torch.float64)


@settings(deadline=None)
@given(CONTRASTS)
def test_the_curve_rises_and_keeps_black_middle_and_white(contrast):
    tone = Tone(contrast)
    fixed = torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64)
    torch.testing.assert_close(tone.shown(fixed), fixed)
    assert (tone.shown(RAMP).diff() > 0).all()
    assert float(tone.slope(fixed)[1]) == pytest.approx(1 + contrast / 2)


@settings(deadline=None)
@given(CONTRASTS)
def test_slopes_by_value_and_contrast_are_central_differences(contrast):
    step = 1e-6
    found = (Tone(contrast).shown(RAMP + step) - Tone(contrast).shown(RAMP - step))[1:] / (2 * step)
    torch.testing.assert_close(Tone(contrast).slope(RAMP)[1:], found, rtol=1e-5, atol=2e-6)
    found = (Tone(contrast + step).shown(RAMP) - Tone(contrast - step).shown(RAMP)) / (2 * step)
    torch.testing.assert_close(bend(RAMP), found, rtol=1e-6, atol=1e-8)


@settings(deadline=None)
@given(CONTRASTS)
def test_what_is_undone_was_shown(contrast):
    inside = RAMP[RAMP <= 1]
    np.testing.assert_allclose(Tone(contrast).undone(Tone(contrast).shown(inside).numpy()), inside, atol=1e-6)


def hues_of(contrast: float, white: float = 0.3, seed: int = 0):
    """Hues of 2000 places in 6 photos, whose prediction errs by ``white`` in all channels alike."""
    rng = np.random.default_rng(seed)
    place, color = np.repeat(np.arange(2000), 6), rng.uniform(0.15, 0.9, (2000, 3))
    brightness = rng.uniform(0.3, 1.0, len(place))
    value = torch.from_numpy(color[place] * brightness[:, None])
    lit = value * torch.from_numpy(np.exp(white * rng.standard_normal((len(place), 1)))).clamp(max=1 / 0.9)
    photo = Tone(contrast).shown(lit) + 0.004 * torch.from_numpy(rng.standard_normal(value.shape))

    def without(tone: Tone) -> Hues:
        shown, bent = np.log(tone.undone(photo.numpy())), bend(value) / value / tone.slope(value)
        residual, slope = (x[:, 0] - x[:, 1] for x in (shown, bent.numpy()))
        slopes = np.c_[rng.standard_normal((len(place), 2)), slope]
        return Hues(place, residual, slopes, np.ones(len(place)))

    return without


@pytest.mark.parametrize("contrast", [0.2, 0.4, 0.7])
def test_a_curve_is_found_by_hues_whatever_brightness_says(contrast):
    tone, decision = judged(hues_of(contrast), "auto")
    assert decision.state == "on" and tone.contrast == pytest.approx(contrast, abs=0.03)


@pytest.mark.parametrize("seed", range(5))
def test_no_curve_is_found_where_there_is_none(seed):
    tone, decision = judged(hues_of(0.0, seed=seed), "auto")
    assert tone is None and decision.state == "off"
    assert steadied(Tone(), hues_of(0.0, seed=seed)).contrast < LEAST_CONTRAST / 2


def test_dark_places_that_are_redder_are_no_curve():
    assert judged(hues_of(-0.4), "auto")[0] is None


def beside_a_bounce(contrast: float, strength: float = 0.0, apart: float = 0.07):
    """The hues of a curve, turned as well by ``strength`` of a bounce that turns them nearly as curves do."""
    hues = hues_of(contrast)

    def without(tone: Tone) -> Hues:
        found = hues(tone)
        curve = found.slopes[:, -1]
        bounce = curve + apart * curve.std() * np.random.default_rng(5).standard_normal(len(curve))
        slopes = np.c_[found.slopes[:, :-1], bounce, curve]
        return replace(found, residual=found.residual + strength * bounce, slopes=slopes)

    return without


def test_a_curve_is_found_beside_a_bounce_that_turns_hues_nearly_as_it_does():
    tone, decision = judged(beside_a_bounce(0.3), "auto")
    assert decision.state == "on" and tone.contrast == pytest.approx(0.3, abs=0.03)


def test_a_bounce_of_another_strength_is_no_curve():
    assert judged(beside_a_bounce(0.0, strength=0.3), "auto")[0] is None


def test_a_bounce_of_another_strength_makes_no_curve_of_a_faint_one_and_half_of_the_least_is_a_hint():
    assert judged(beside_a_bounce(0.03, strength=0.3, apart=0.6), "auto")[0] is None
    assert judged(beside_a_bounce(0.07, strength=0.3, apart=0.6), "auto")[0] is not None


@pytest.mark.parametrize(("found", "any_strength", "on"), [(0.09, 0.35, True), (0.34, 0.04, False)])
def test_beside_a_bounce_that_has_made_up_for_it_a_curve_may_be_faint_but_not_beside_any(
    monkeypatch, found, any_strength, on
):
    trials = [(Tone(contrast), Verdict(0.2, 30.0)) for contrast in (found, any_strength)]
    monkeypatch.setattr(evidence, "_trials", lambda without: trials)
    curve, _ = judged(hues_of(0.0), "auto")
    assert (curve is not None) == on
    assert not on or curve.contrast == pytest.approx((found + any_strength) / 2)


def test_a_curve_is_on_where_it_is_asked_for():
    tone, decision = judged(hues_of(0.0), "on")
    assert tone is not None and decision.reason.startswith("forced on")


def test_too_few_hues_say_nothing():
    def without(tone: Tone) -> Hues:
        return Hues(np.zeros(0, int), np.zeros(0), np.zeros((0, 3)), np.zeros(0))

    assert judged(without, "auto")[0] is None and judged(without, "on")[0] == Tone()

"""An effect is worth its place by more where the rest of the model errs by more."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from endotwin.evidence.probe import Hypothesis
from endotwin.evidence.verdict import Verdict
from endotwin.evidence.worth import worth


def model(bounces: bool, leaves: float = 0.005) -> SimpleNamespace:
    """What is asked of a fitted model: whether light bounces, and what it leaves."""
    hypothesis = Hypothesis(bounced=object() if bounces else None)
    return SimpleNamespace(hypothesis=hypothesis, effects=SimpleNamespace(width=leaves))


def test_guides_that_gain_little_are_worth_their_place_only_where_no_light_bounces():
    little, usual, much = Verdict(0.06, 6), Verdict(0.25, 4), Verdict(0.55, 4)
    assert worth("offset", little, model(bounces=False)) and worth("offset", usual, model(bounces=False))
    assert not worth("offset", usual, model(bounces=True)) and worth("offset", much, model(bounces=True))


def test_vignetting_that_explains_more_than_rounding_is_worth_its_place_however_much_is_left():
    by_a_percent = Verdict(10 * np.log10(1 + 0.01), 5)
    assert worth("vignetting", by_a_percent, model(bounces=True, leaves=0.012))
    assert not worth("vignetting", by_a_percent, model(bounces=True, leaves=0.01))
    assert not worth("vignetting", replace(by_a_percent, sigmas=2), model(bounces=True, leaves=0.012))
    assert not worth("vignetting", replace(by_a_percent, possible=False), model(bounces=True, leaves=0.012))


def test_a_bounce_that_pixels_hardly_tell_is_told_by_a_light_that_is_likelier():
    assert worth("interreflection", Verdict(-0.1, -2, likelier=2.5), model(bounces=True))
    assert not worth("interreflection", Verdict(-0.1, -2, likelier=1.5), model(bounces=True))
    assert not worth("interreflection", Verdict(-0.3, -2, likelier=2.5), model(bounces=True))


@pytest.mark.parametrize("name", ["interreflection", "vignetting", "profile", "offset", "gain"])
def test_with_a_light_that_no_endoscope_has_every_effect_has_to_gain_plainly(name):
    assert not worth(name, Verdict(1.0, 20, possible=False), model(bounces=False))
    assert worth(name, Verdict(3.1, 20, possible=False), model(bounces=False))

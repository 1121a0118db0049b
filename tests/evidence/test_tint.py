"""Bounced light, told by the hue of places whatever their brightness does."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from endotwin.effects.tone import Tone
from endotwin.evidence.tint import turned
from endotwin.evidence.worth import LEAST

PLACES, SIGHTINGS, GAMMA = 1500, 12, 0.45


def photos(strength: float, contrast: float = 0.0, seed: int = 0) -> tuple[SimpleNamespace, np.ndarray]:
    """8-bit photos of places under lamp light of any brightness, and light of the colour of tissue besides;
    and ln of both in each channel, if the latter is as strong as ``strength`` 1 would have it."""
    generator = np.random.default_rng(seed)
    vertex = np.repeat(np.arange(PLACES), SIGHTINGS)
    lamp = np.exp(generator.normal(-1.0, 0.7, len(vertex)))[:, None]
    tissue = np.exp(generator.normal(-2.5, 0.5, len(vertex)))[:, None] * [1.0, 0.5, 0.4]
    albedo = generator.uniform([0.5, 0.2, 0.15], [0.9, 0.4, 0.3], (PLACES, 3))[vertex]
    smooth = (albedo * (lamp + strength * tissue)) ** GAMMA
    shown = Tone(contrast).shown(torch.from_numpy(smooth)).numpy()
    shown = shown + generator.normal(0, 1 / 255, smooth.shape)
    probe = SimpleNamespace(
        vertex=vertex,
        count=PLACES,
        half=(generator.random(PLACES) < 0.5)[vertex],
        shown_colors=np.clip(np.round(shown * 255), 1, 255) / 255,
        smooth_colors=lambda model: smooth,
    )
    return probe, np.log(lamp + tissue)


@pytest.mark.parametrize("strength", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("contrast", [0.0, 0.4])
def test_light_of_the_colour_of_tissue_shows_in_hues_under_any_tone_curve(strength, contrast):
    probe, log_colors = photos(strength, contrast)
    verdict = turned(probe, None, log_colors)
    assert verdict.worth(LEAST) and verdict.sigmas > 10


@pytest.mark.parametrize("contrast", [0.0, 0.4])
@pytest.mark.parametrize("seed", range(3))
def test_white_light_of_any_brightness_tells_of_no_bounce_whatever_the_tone_curve(contrast, seed):
    probe, log_colors = photos(0.0, contrast, seed)
    assert not turned(probe, None, log_colors).worth(LEAST)


def test_light_of_the_other_colour_is_no_bounce():
    probe, log_colors = photos(1.0)
    assert not turned(probe, None, log_colors[:, ::-1]).worth(LEAST)


def test_grey_photos_tell_nothing_of_a_bounce():
    probe, log_colors = photos(1.0)
    probe.shown_colors = np.repeat(probe.shown_colors[:, :1], 3, axis=1)
    probe.smooth_colors = lambda model: probe.shown_colors
    for light in (log_colors, np.repeat(log_colors[:, :1], 3, axis=1)):
        verdict = turned(probe, None, light)
        assert np.isfinite([verdict.gain_db, verdict.sigmas]).all() and not verdict.worth(LEAST)

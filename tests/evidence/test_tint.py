"""Bounced light and white balance, told by the hue of places whatever their brightness does."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from endotwin.effects.tone import Tone
from endotwin.evidence.decide import RULED_OUT_SIGMAS
from endotwin.evidence.tint import Tints
from endotwin.evidence.worth import LEAST

PLACES, SIGHTINGS, FRAMES, GAMMA = 1500, 12, 20, 0.45


def photos(
    strength: float, contrast: float = 0.0, seed: int = 0, cast: np.ndarray | float = 0.0
) -> tuple[SimpleNamespace, np.ndarray]:
    """8-bit photos of places under lamp light of any brightness, and light of the colour of tissue besides;
    and ln of both in each channel, if the latter is as strong as ``strength`` 1 would have it. Values of
    photos are multiplied by exp(``cast``), [FRAMES, 3]."""
    generator = np.random.default_rng(seed)
    vertex = np.repeat(np.arange(PLACES), SIGHTINGS)
    frame = generator.integers(FRAMES, size=len(vertex))
    lamp = np.exp(generator.normal(-1.0, 0.7, len(vertex)))[:, None]
    tissue = np.exp(generator.normal(-2.5, 0.5, len(vertex)))[:, None] * [1.0, 0.5, 0.4]
    albedo = generator.uniform([0.5, 0.2, 0.15], [0.9, 0.4, 0.3], (PLACES, 3))[vertex]
    smooth = (albedo * (lamp + strength * tissue)) ** GAMMA
    smooth = smooth * np.exp(np.broadcast_to(cast, (FRAMES, 3)))[frame]
    shown = Tone(contrast).shown(torch.from_numpy(smooth)).numpy()
    shown = shown + generator.normal(0, 1 / 255, smooth.shape)
    probe = SimpleNamespace(
        vertex=vertex,
        count=PLACES,
        frame=frame,
        frames=np.arange(FRAMES) + 7,
        half=(generator.random(PLACES) < 0.5)[vertex],
        shown_colors=np.clip(np.round(shown * 255), 1, 255) / 255,
        smooth_colors=lambda model: smooth,
    )
    return probe, np.log(lamp + tissue)


@pytest.mark.parametrize("strength", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("contrast", [0.0, 0.4])
def test_light_of_the_colour_of_tissue_shows_in_hues_under_any_tone_curve(strength, contrast):
    probe, log_colors = photos(strength, contrast)
    tints = Tints(probe, None, log_colors)
    assert tints.bounced.worth(LEAST) and tints.bounced.sigmas > 10 and tints.still.sigmas < -10


@pytest.mark.parametrize("contrast", [0.0, 0.4])
@pytest.mark.parametrize("seed", range(3))
def test_white_light_of_any_brightness_tells_of_no_bounce_whatever_the_tone_curve(contrast, seed):
    probe, log_colors = photos(0.0, contrast, seed)
    tints = Tints(probe, None, log_colors)
    assert not tints.bounced.worth(LEAST) and tints.still.sigmas > RULED_OUT_SIGMAS


def test_light_of_the_other_colour_is_no_bounce():
    probe, log_colors = photos(1.0)
    assert not Tints(probe, None, log_colors[:, ::-1]).bounced.worth(LEAST)


def test_grey_photos_tell_nothing_of_a_bounce():
    probe, log_colors = photos(1.0)
    probe.shown_colors = np.repeat(probe.shown_colors[:, :1], 3, axis=1)
    probe.smooth_colors = lambda model: probe.shown_colors
    for light in (log_colors, np.repeat(log_colors[:, :1], 3, axis=1)):
        tints = Tints(probe, None, light)
        verdict = tints.bounced
        assert np.isfinite([verdict.gain_db, verdict.sigmas]).all() and not verdict.worth(LEAST)
        assert tints.casts() is None
    assert abs(tints.still.sigmas) < 1


def casts(**of: tuple[float, float]) -> np.ndarray:
    """ln of red and of blue in photos, by name of their rows; [FRAMES, 3]."""
    log = np.zeros((FRAMES, 3))
    for name, (red, blue) in of.items():
        log[int(name[5:])] = red, 0, blue
    return log


@pytest.mark.parametrize("strength", [0.0, 1.0])
@pytest.mark.parametrize("contrast", [0.0, 0.4])
def test_photos_of_another_white_balance_are_told_from_a_bounce_and_a_tone_curve(strength, contrast):
    true = casts(photo3=(-0.08, 0.0), photo11=(0.03, 0.05))
    probe, log_colors = photos(strength, contrast, cast=true)
    found = Tints(probe, None, log_colors).casts()
    assert found.frames.tolist() == [10, 18]
    bent = 1 + contrast * np.array([-1, 0.5])[:, None, None]  # slopes of the curve at its ends and its middle
    low, high = np.sort(true[[3, 11]] * bent, axis=0)
    assert (found.log > low - 0.004).all() and (found.log < high + 0.004).all()


@pytest.mark.parametrize("strength", [0.0, 1.0])
@pytest.mark.parametrize("seed", range(3))
def test_photos_that_agree_have_no_casts(strength, seed):
    probe, log_colors = photos(strength, seed=seed)
    assert Tints(probe, None, log_colors).casts() is None


def test_where_light_and_white_balance_drift_together_no_photo_stands_out():
    drift = np.linspace(-0.03, 0.03, FRAMES)[:, None] * [1, 0, -0.5]
    probe, log_colors = photos(0.5, cast=drift)
    assert Tints(probe, None, log_colors).casts() is None


def test_a_photo_of_which_few_pixels_tell_has_no_cast():
    probe, log_colors = photos(0.0)
    few = np.flatnonzero(probe.frame == 4)[:3]
    rest = np.flatnonzero(probe.frame != 4)
    rows = np.sort(np.r_[few, rest])
    color = probe.shown_colors
    color[few] = np.clip(color[few] * np.exp([[0.4, 0, 0], [-0.3, 0, 0], [0.3, 0, 0]]), 1 / 255, 1)
    columns = {name: getattr(probe, name)[rows] for name in ("vertex", "frame", "half", "shown_colors")}
    smooth = probe.smooth_colors(None)[rows]
    part = SimpleNamespace(**{**vars(probe), **columns, "smooth_colors": lambda model: smooth})
    assert Tints(part, None, log_colors[rows]).casts() is None


def test_a_photo_that_shows_places_of_its_own_has_no_cast_whatever_the_first_photo_has():
    probe, log_colors = photos(0.0, cast=casts(photo0=(-0.09, 0.0)))
    alone = probe.frame == FRAMES - 1
    probe.vertex = np.where(alone, probe.count, 0) + probe.vertex
    probe.count *= 2
    assert Tints(probe, None, log_colors).casts().frames.tolist() == [7]


def test_a_single_photo_is_of_no_other_white_balance_than_itself():
    probe, log_colors = photos(0.0)
    one = SimpleNamespace(**{**vars(probe), "frames": probe.frames[:1], "frame": np.zeros_like(probe.frame)})
    assert Tints(one, None, log_colors).casts() is None

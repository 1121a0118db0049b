"""Light, response and f0 from the variation within vertices, whatever the tissue's texture."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from endotwin.effects.coat import Coat
from endotwin.effects.tone import Tone
from endotwin.effects.vignetting import Vignetting
from endotwin.evidence.coat import judged
from endotwin.evidence.tone import CONTRAST, Hues, steadied
from endotwin.evidence.tone import judged as judged_tone
from endotwin.fit.model import Globals, predict
from endotwin.fit.state import ROUGHNESS_RANGE, roughness_to_raw
from endotwin.fit.within import MODEL_ERROR, Varied, Within
from endotwin.light.bounced import Bounce
from endotwin.pixels.samples import Samples, Views
from endotwin.pixels.start import DIFFUSE_SIN2, LIGHT_MEAN
from endotwin.twin import Light, Response

VERTICES, SIGHTINGS = 600, 40
TRUE = Globals.of(Light(120.0, 1.7, 2.2), Response(0.42), f0=0.035)
BOUNCING = Globals.of(Light(120.0, 1.7, 2.2), Response(0.42), f0=0.035, bounce=True)
BRIGHT = Globals.of(Light(360.0, 1.7, 2.2), Response(0.42), f0=0.035)
VIEWS = Views(None, np.ones((1, 1), bool), np.arange(SIGHTINGS), np.tile(np.eye(4), (SIGHTINGS, 1, 1)))
ROUGHNESS = 0.45
NOISE = 1 / 255


def photographed(
    true: Globals = TRUE, seed: int = 0, roughness: float = ROUGHNESS
) -> tuple[Within, torch.Tensor]:
    """8-bit photos of vertices with random albedo, a fifth near the mirror direction; and the materials."""
    generator = np.random.default_rng(seed)
    count = VERTICES * SIGHTINGS
    vertex = np.repeat(np.arange(VERTICES), SIGHTINGS)
    cos = generator.uniform(0.25, 0.92, count)
    shiny = generator.random(count) < 0.2
    cos[shiny] = generator.uniform(0.97, 0.999, shiny.sum())
    albedo = generator.uniform(0.1, 0.8, (VERTICES, 3))[vertex]
    material = torch.from_numpy(np.c_[albedo, np.full(count, roughness)])
    samples = Samples(
        triangle=torch.from_numpy(vertex),
        barycentric=torch.tensor([[0.8, 0.1, 0.1]]).repeat(count, 1),
        cos=torch.from_numpy(cos),
        sin2=torch.from_numpy(1 - cos**2),
        log_cos_axis=torch.from_numpy(np.log(generator.uniform(0.5, 1, count))),
        log_distance=torch.from_numpy(np.log(generator.uniform(12, 40, count))),
        color=torch.zeros(count, 3, dtype=torch.uint8),
        frame=torch.from_numpy(np.tile(np.arange(SIGHTINGS, dtype=np.int32), VERTICES)),
        pixel=torch.zeros(count, dtype=torch.int32),
    )
    return Within(recorded(samples, material, true, generator), vertex, VERTICES, 1.0), material


def recorded(
    samples: Samples, material: torch.Tensor, true: Globals, generator: np.random.Generator
) -> Samples:
    """``samples`` with 8-bit photos of what they show, with noise."""
    shown = predict(samples, material, true).numpy()
    shown = shown + generator.normal(0, NOISE, shown.shape)
    return replace(samples, color=torch.from_numpy(np.uint8(np.clip(shown, 0, 1) * 255 + 0.5)))


def told(shared: Globals) -> list[float]:
    return [shared.gamma, *shared.log_light[1:], shared.f0]


@pytest.mark.parametrize("gamma, n, q", [(0.45, 2.0, 2.0), (0.6, 1.0, 1.5), (0.3, 3.0, 2.8)])
def test_light_response_and_f0_are_found_beside_an_albedo_that_is_nowhere_right(gamma, n, q):
    within, material = photographed()
    grey = material.clone()
    grey[:, :3] = 0.4
    shared = Globals.of(Light(120.0, n, q), Response(gamma), f0=0.06)
    for _ in range(8):
        shared = within.renewed(grey, shared, (), NOISE).shared
    assert told(shared)[:3] == pytest.approx(told(TRUE)[:3], rel=0.02)
    for _ in range(4):
        shared = within.renewed(material, shared, (), NOISE).shared
    assert told(shared) == pytest.approx(told(TRUE), rel=0.01)


def test_what_a_lens_dims_stays_as_the_probe_has_found_it():
    within, material = photographed()
    radius2 = torch.from_numpy(np.random.default_rng(7).uniform(0, 1.4, len(material)))
    behind = replace(within, samples=replace(within.samples, radius2=radius2))
    found = behind.renewed(material, TRUE.behind(Vignetting(-0.1)), (), NOISE).shared
    assert found.k2 == pytest.approx(-0.1) and told(found) != told(TRUE)


@pytest.mark.parametrize("tail", [1.0, 2.0])
def test_a_coat_is_found_with_its_roughness_tail_and_weight(tail):
    within, material = photographed(replace(TRUE, coat=Coat(0.8, 0.19, tail)))
    coat, decision = judged(within.highlights(material, TRUE, NOISE), "auto")
    assert decision.state == "on" and (coat.roughness, coat.tail) == (0.19, tail)
    shared = replace(TRUE, coat=coat)
    for _ in range(6):
        shared = within.renewed(material, shared, (), NOISE).shared
    assert shared.coat.weight == pytest.approx(0.8, rel=0.05)
    assert told(shared) == pytest.approx(told(TRUE), rel=0.02)


def coloured(within: Within, material: torch.Tensor, shared: Globals) -> torch.Tensor:
    """The materials with base colours under which each vertex is as bright as its photos, in the mean."""
    shown = within.samples.color.double() / 255
    if shared.tone is not None:
        shown = torch.from_numpy(shared.tone.undone(shown.numpy()))
    brighter = torch.log(shown) - torch.log(predict(within.samples, material, shared.under(None)))
    dull = ((within.samples.sin2 > DIFFUSE_SIN2)[:, None] * (shown < 1)).double()
    mean = torch.zeros(VERTICES, 3, dtype=torch.float64), torch.from_numpy(within.vertex)
    brighter = mean[0].index_add(0, mean[1], dull * brighter) / mean[0].index_add(0, mean[1], dull)
    colors = material[:, :3] * (brighter / shared.gamma).exp()[within.vertex]
    return torch.cat([colors, material[:, 3:]], dim=1)


@pytest.mark.parametrize("contrast", [0.2, 0.4])
def test_a_tone_curve_is_found_with_light_and_response_that_begin_elsewhere(contrast):
    within, material = photographed(TRUE.under(Tone(contrast)))
    shared = Globals.of(Light(120.0, 2.2, 2.0), Response(0.5), f0=0.045)
    material = coloured(within, material, shared)
    tone, decision = judged_tone(within.hues(material, shared, NOISE), "auto")
    assert decision.state == "on" and tone.contrast == pytest.approx(contrast, abs=0.05)
    shared = shared.under(tone)
    for _ in range(8):
        material = coloured(within, material, shared)
        shared = within.renewed(material, shared, (), NOISE).shared
        shared = shared.under(steadied(shared.tone, within.hues(material, shared, NOISE)))
    assert shared.tone.contrast == pytest.approx(contrast, abs=0.03)
    assert told(shared)[:3] == pytest.approx(told(TRUE)[:3], rel=0.03)


def test_photos_without_a_tone_curve_get_none_whatever_the_light():
    within, material = photographed()
    for light, gamma in ((Light(120.0, 2.2, 2.0), 0.5), (Light(120.0, 1.0, 2.6), 0.35)):
        shared = Globals.of(light, Response(gamma), f0=0.035)
        seen = within.hues(coloured(within, material, shared), shared, NOISE)
        assert judged_tone(seen, "auto")[0] is None


def test_hues_that_no_curve_steadies_tell_of_none():
    within, material = photographed(TRUE.under(Tone(0.4)))
    seen = within.hues(coloured(within, material, TRUE), TRUE, NOISE)

    def turned(tone: Tone) -> Hues:
        hues = seen(tone)
        return replace(hues, residual=hues.residual + hues.slopes[:, -1])

    assert judged_tone(seen, "auto")[0].contrast == pytest.approx(0.4, abs=0.05)
    tone, decision = judged_tone(turned, "auto")
    assert tone is None and decision.state == "off"
    forced, _ = judged_tone(turned, "on")
    assert forced.contrast == CONTRAST.high


def test_a_hint_of_a_coat_is_enough_where_all_pixels_are_asked_next():
    within, material = photographed(replace(TRUE, coat=Coat(0.15, 0.13, 2.0)))
    highlights = within.highlights(material, TRUE, NOISE)
    assert judged(highlights, "auto")[0] is None
    coat, decision = judged(highlights, "auto", tried=True)
    assert decision.state == "on" and coat.weight > 0


def test_tissue_without_a_coat_gets_none_and_one_that_is_forced_on_weighs_nothing():
    within, material = photographed()
    assert judged(within.highlights(material, TRUE, NOISE), "auto")[0] is None
    forced, decision = judged(within.highlights(material, TRUE, NOISE), "on")
    assert decision.state == "on" and forced.weight < 0.02


@pytest.mark.parametrize("roughness", [0.25, 0.7])
def test_the_shape_of_diffuse_light_does_not_bend_the_response(roughness):
    within, material = photographed(replace(TRUE, specular=False), roughness=roughness)  # 0.25: Lambert's
    material = at_roughness(material, roughness_to_raw(ROUGHNESS))
    shared = replace(TRUE, specular=False)
    for _ in range(6):
        shared = within.renewed(material, shared, (), NOISE).shared
    assert told(shared)[:3] == pytest.approx(told(TRUE)[:3], rel=0.02)


def test_highlights_that_clip_bear_a_coat_out():
    within, material = photographed(replace(BRIGHT, coat=Coat(0.3, 0.13)))
    rows = torch.nonzero((within.samples.color < 255).all(dim=1))[:, 0]
    dull = replace(within, samples=within.samples[rows], vertex=within.vertex[rows.numpy()])
    _, all_told = judged(within.highlights(material, BRIGHT, NOISE), "auto")
    _, unclipped = judged(dull.highlights(material[rows], BRIGHT, NOISE), "auto")
    assert len(rows) < 0.99 * len(material)
    assert all_told.gain_db > 1.2 * unclipped.gain_db


def test_tissue_that_clips_without_a_coat_gets_none():
    within, material = photographed(BRIGHT)
    assert judged(within.highlights(material, BRIGHT, NOISE), "auto")[0] is None


def at_roughness(material: torch.Tensor, logit: torch.Tensor | float) -> torch.Tensor:
    low, high = ROUGHNESS_RANGE
    material[:, 3] = low + (high - low) * torch.sigmoid(torch.as_tensor(logit))
    return material


def test_roughness_that_is_off_everywhere_is_no_coat():
    within, material = photographed()
    material = at_roughness(material, roughness_to_raw(0.55))
    assert judged(within.highlights(material, TRUE, NOISE), "auto")[0] is None


def test_roughness_f0_and_a_coat_are_told_from_each_other():
    """The roughness of all tissue is off, and at first the coat makes up for it."""
    true = replace(TRUE, coat=Coat(0.8, 0.09))
    within, material = photographed(true)
    shared, logit = replace(TRUE, coat=Coat(0.4, 0.09)), roughness_to_raw(0.55)
    for _ in range(10):
        found = within.shone(at_roughness(material, logit), shared, NOISE)
        shared, logit = found.shared, logit + found.roughness
    assert float(at_roughness(material, logit)[0, 3]) == pytest.approx(ROUGHNESS, rel=0.02)
    assert shared.coat.weight == pytest.approx(0.8, rel=0.03)
    assert told(shared) == pytest.approx(told(TRUE), rel=0.02)


def test_gains_that_follow_the_distance_are_told_from_the_falloff():
    within, material = photographed()
    frame, log_distance = within.samples.frame.long(), within.samples.log_distance
    nearer = torch.linspace(0, 1, SIGHTINGS, dtype=torch.float64)
    samples = replace(within.samples, log_distance=0.1 * log_distance + 2 + nearer[frame])
    samples = replace(samples, views=Views(None, None, np.arange(SIGHTINGS), None))
    true = 1.8 * (nearer - nearer.mean()) + 0.1 * torch.sin(5 * nearer)
    shown = predict(replace(samples, log_exposure=true[frame]), material, TRUE).numpy()
    shown += np.random.default_rng(1).normal(0, NOISE, shown.shape)
    samples = replace(samples, color=torch.from_numpy(np.uint8(np.clip(shown, 0, 1) * 255 + 0.5)))
    shared, log_gain = Globals.of(Light(120.0, 2.0, 2.0), Response(0.36), f0=0.035), torch.zeros(SIGHTINGS)
    for _ in range(8):
        exposed = replace(within, samples=replace(samples, log_exposure=log_gain[frame]))
        found = exposed.renewed(material, shared, (), NOISE, Varied(SIGHTINGS))
        shared, log_gain = found.shared, log_gain + torch.from_numpy(found.log_gain)
    assert told(shared)[:3] == pytest.approx(told(TRUE)[:3], rel=0.02)
    np.testing.assert_allclose(log_gain - log_gain.mean(), true - true.mean(), atol=0.03)


def test_sightings_of_a_mesh_whose_normals_err_err_as_much_as_they_say_wherever_light_grazes():
    within, material = photographed()
    samples, generator = within.samples, np.random.default_rng(4)
    tilted = torch.arccos(samples.cos) + torch.from_numpy(generator.normal(0, 0.026, len(samples)))
    true = replace(samples, cos=torch.cos(tilted), sin2=torch.sin(tilted) ** 2)
    off = 1 + torch.from_numpy(generator.normal(0, MODEL_ERROR / TRUE.gamma, (len(samples), 1)))
    photos = recorded(true, torch.cat([off * material[:, :3], material[:, 3:]], dim=1), TRUE, generator)
    seen = replace(within, samples=replace(samples, color=photos.color))
    for some in (samples.cos < 0.4, (samples.cos > 0.7) & (samples.sin2 > DIFFUSE_SIN2)):
        each = seen.sightings(material, TRUE, some, NOISE / np.sqrt(3))
        assert (each.residual**2 * each.weight).mean() == pytest.approx(1, rel=0.4)


def test_what_is_held_stays():
    within, material = photographed()
    shared = Globals.of(Light(120.0, 2.0, 2.0), Response(0.45), f0=0.05)
    renewed = within.renewed(material, shared, ("n", "gamma"), NOISE).shared
    assert (renewed.gamma, renewed.log_light[1]) == (pytest.approx(0.45), pytest.approx(2.0))
    assert renewed.log_light[2] != pytest.approx(2.0, rel=1e-3)


def test_without_a_specular_lobe_f0_stays():
    within, material = photographed()
    shared = replace(TRUE, specular=False)
    assert within.renewed(material, shared, (), NOISE).shared.vector[4] == TRUE.vector[4]


def test_photos_of_one_distance_leave_the_falloff_near_its_prior():
    within, material = photographed()
    samples = replace(within.samples, log_distance=torch.full_like(within.samples.log_distance, np.log(20)))
    shared = Globals.of(Light(120.0, 1.7, 2.0), Response(0.42), f0=0.035)
    found = replace(within, samples=samples).renewed(material, shared, (), NOISE).shared
    assert found.gamma * found.log_light[2] == pytest.approx(LIGHT_MEAN[1], rel=1e-3)
    assert found.gamma == pytest.approx(0.42, rel=0.04)  # told by the diffuse lobe alone


def test_photos_without_a_usable_pixel_change_nothing():
    within, material = photographed()
    white = replace(within.samples, color=torch.full_like(within.samples.color, 255))
    assert replace(within, samples=white).renewed(material, TRUE, (), NOISE).shared is TRUE


def test_a_black_shadow_that_is_a_little_off_does_not_bend_the_light():
    within, material = photographed()
    color, far = within.samples.color.clone(), within.samples.log_distance > np.log(36)
    color[far & (torch.arange(len(color)) % 2 == 0)] = 3
    within = replace(within, samples=replace(within.samples, color=color))
    shared = TRUE
    for _ in range(3):
        shared = within.renewed(material, shared, (), NOISE).shared
    assert told(shared)[:3] == pytest.approx(told(TRUE)[:3], rel=0.01)


def test_under_a_coat_that_shines_a_clipped_photo_says_at_least():
    within, material = photographed()
    white = replace(within, samples=replace(within.samples, color=torch.full_like(within.samples.color, 255)))
    every = torch.ones(len(material), dtype=torch.bool)

    def seen(weight: float, L0: float) -> np.ndarray:
        shared = Globals.of(Light(L0, 1.7, 2.2), Response(0.42), f0=0.035)
        return white.sightings(material, replace(shared, coat=Coat(weight, 0.1)), every, NOISE).residual

    assert not len(seen(0.0, 120.0))
    assert len(seen(0.5, 120.0)) > 1000 and (seen(0.5, 120.0) > 0).all()
    assert not len(seen(0.5, 1e9))


def test_f0_is_found_beside_a_bounce():
    generator = np.random.default_rng(5)
    within, material = photographed()
    count, none = len(within.samples), torch.zeros(len(within.samples))
    log = np.log(0.1) - 2 * within.samples.log_distance[:, None] + torch.zeros(count, 3)
    dull = torch.tensor([0.0, 1.0]).expand(count, 2)
    bounce = Bounce(log.float(), none, none, torch.ones(count, 3), torch.zeros(count, 3), dull)
    samples = replace(within.samples, bounce=bounce, views=VIEWS)
    within = replace(within, samples=recorded(samples, material, BOUNCING, generator))
    shared = Globals.of(Light(120.0, 1.7, 2.2), Response(0.42), f0=0.07, bounce=True)
    for _ in range(8):
        shared = within.shone(material, shared, NOISE).shared
    assert told(shared) == pytest.approx(told(BOUNCING), rel=0.02)

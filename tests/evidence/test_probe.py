"""What the probe tells of light and tissue, on the geometry of a real walk through a colon."""

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from independent.light import burley, ggx

from endotwin.config import STANDARD
from endotwin.evidence.bounce import Patches, Surroundings
from endotwin.evidence.light_map import LightMap, places_mm
from endotwin.evidence.probe import LEAST_COS, Hypothesis, Probe, log_light
from endotwin.evidence.sightings import Sightings
from endotwin.evidence.verdict import MIN_SIGMAS, Verdict, verdict_of
from endotwin.evidence.worth import LEAST
from endotwin.pipeline import fuse_twin
from endotwin.pixels.pace import Pace
from endotwin.pixels.samples import gather
from endotwin.surface.casting import Caster

pytestmark = pytest.mark.slow

EXAMPLE = Path(__file__).parents[2] / "examples" / "colon_small"
BESIDE = Hypothesis(guides_mm=((4.0, 0.0, 0.0),), shadows=True)


@pytest.fixture(scope="module")
def example():
    twin = fuse_twin(EXAMPLE)
    caster = Caster(twin.surface)
    return Probe(gather(twin, Pace(STANDARD.fit), 0, caster), twin, caster)


def shown(probe: Probe, roughness: float, f0: float, retro: bool) -> Probe:
    """The probe of a wall with such a lobe, whose albedos vary about a half, under a light at the lens with
    n = 2.5 and q = 2, seen by a camera of gamma 1/2.2 with noise."""
    rng = np.random.default_rng(5)
    albedo = (0.5 * np.exp(rng.normal(0, 0.2, probe.count)))[probe.vertex]
    to_eye = -probe.points_mm / np.linalg.norm(probe.points_mm, axis=1, keepdims=True)
    rough = np.full(len(probe), roughness)
    diffuse = burley(probe.normals, to_eye, to_eye, rough if retro else np.full(len(probe), 0.25))
    shine = np.pi * ggx(probe.normals, to_eye, to_eye, rough, f0)
    distance = np.linalg.norm(probe.points_mm, axis=1)
    x = (albedo * diffuse + shine) * (-to_eye[:, 2]) ** 2.5 / distance**2
    lit = copy.copy(probe)
    lit.target = np.log(x) / 2.2 + rng.normal(0, 0.01, len(probe))
    return lit


@pytest.mark.parametrize(
    ("roughness", "f0", "retro"), [(0.55, 0.045, True), (0.4, 0.02, True), (0.5, 0.04, False)]
)
def test_a_rough_lobe_bends_no_light_and_passes_for_no_other_effect(example, roughness, f0, retro):
    probe = shown(example, roughness, f0, retro)
    plain = probe.fit(Hypothesis())
    assert plain.gamma == pytest.approx(1 / 2.2, rel=0.03)
    assert plain.n == pytest.approx(2.5, rel=0.04)
    assert plain.q == pytest.approx(2, rel=0.04)
    assert plain.tissue.roughness == pytest.approx(roughness, abs=0.1)
    others = (Hypothesis(gain=True), Hypothesis(profile=1.0), BESIDE)
    assert not any(probe.compare(plain, probe.fit(each)).keep for each in others)
    assert not probe.compare(plain, probe.fit(Hypothesis(vignetting=True))).worth(LEAST)


def exposed(probe: Probe, even: Hypothesis, log_gain: np.ndarray, log_bounce: np.ndarray) -> Probe:
    """The probe of a Lambertian wall under ``even`` light, all of which, or its bounce, is off by so much in
    each frame [F]."""
    rng, light = np.random.default_rng(2), log_light(probe, even)
    albedo = rng.normal(0, 0.2, probe.count)[probe.vertex]
    direct, bounced = light.irradiance(2, 2), np.exp(light.bounced.log)
    lit = copy.copy(probe)
    log_lit = np.log(direct + bounced * np.exp(log_bounce[probe.frame])) + log_gain[probe.frame]
    lit.target = (albedo + log_lit) / 2.2 + rng.normal(0, 0.01, len(probe))
    return lit


def test_a_gain_and_a_bounce_that_errs_from_frame_to_frame_are_told_apart(example):
    """As strong as they pass for each other: each is the better model of what it made itself."""
    even = Hypothesis(bounced=Surroundings(example, Patches(example)).bounced(Hypothesis()))
    wander = np.sin(np.arange(len(example.frames)))

    def verdict(log_gain: float, log_bounce: float) -> Verdict:
        lit = exposed(example, even, log_gain * wander, log_bounce * wander)
        gain, uneven = (lit.fit(replace(even, **{name: True})) for name in ("gain", "uneven"))
        assert lit.compare(lit.fit(even), gain).keep
        return lit.compare(uneven, gain)

    assert verdict(log_gain=0.04, log_bounce=0).sigmas > MIN_SIGMAS
    assert verdict(log_gain=0, log_bounce=0.15).sigmas < -MIN_SIGMAS


def test_a_gain_that_flickers_is_told_beside_all_that_drifts_along_the_path_and_what_drifts_is_none(example):
    even = Hypothesis(bounced=Surroundings(example, Patches(example)).bounced(Hypothesis()))
    frames = np.arange(len(example.frames))

    def verdict(log_gain: np.ndarray, log_bounce: np.ndarray) -> Verdict:
        lit = exposed(example, even, log_gain, log_bounce)
        assert lit.compare(lit.fit(even), lit.fit(replace(even, gain=True))).keep
        adrift = replace(even, adrift=True)
        return lit.compare(lit.fit(adrift), lit.fit(replace(adrift, gain=True)))

    flicker, drift = 0.03 * (-1.0) ** frames, 0.3 * (frames / frames[-1] - 0.5)
    assert verdict(log_gain=flicker, log_bounce=0 * drift).keep
    assert verdict(log_gain=flicker, log_bounce=drift).keep
    assert verdict(log_gain=0 * flicker, log_bounce=drift).gain_db < LEAST.gain_db
    assert verdict(log_gain=drift, log_bounce=0 * drift).gain_db < LEAST.gain_db


def test_drifts_are_of_variance_one_and_as_alike_as_frames_are_near(example):
    drifts, T = example.drifts, example.T_local_camera
    covariance = drifts @ drifts.T
    assert np.diag(covariance) == pytest.approx(1, abs=0.05)
    apart_mm = np.linalg.norm(T[:, None, :3, 3] - T[None, :, :3, 3], axis=-1)
    first = covariance[0][np.argsort(apart_mm[0])]
    assert (np.diff(first) < 0.05).all()
    assert first[-1] < 0.9


@pytest.mark.parametrize(
    "guides_mm",
    [[(0.0, 0, 0)], [(3.5, 1, 0)], [(3.0, 1, 0), (-2, -3, 0)], [(4.0, 0.5, 0), (-2, 3, 0), (-2, -3.5, 0)]],
)
def test_a_map_of_the_light_shows_from_where_it_comes_and_where_its_guides_stand(example, guides_mm):
    guides_mm, rng = np.array(guides_mm), np.random.default_rng(5)
    light = 0.0
    for guide_mm in guides_mm:
        towards = guide_mm - example.points_mm
        distance = np.linalg.norm(towards, axis=1)
        wi = towards / distance[:, None]
        lit = example.visible(guide_mm[None])[:, 0] * np.maximum((wi * example.normals).sum(axis=1), 0)
        light = light + lit * (-wi[:, 2]) ** 2.5 / distance**2
    albedo = (0.5 * np.exp(rng.normal(0, 0.2, example.count)))[example.vertex]
    rows = np.flatnonzero(light > 0)
    probe = copy.copy(example)
    probe.samples = example.samples[torch.from_numpy(rows)]
    probe.vertex = np.unique(example.vertex[rows], return_inverse=True)[1]
    probe.count = 1 + int(probe.vertex.max())
    for name in (
        "frame",
        "points_mm",
        "normals",
        "local_points_mm",
        "local_normals",
        "vignetting_column",
        "trust",
    ):
        vars(probe)[name] = getattr(example, name)[rows]
    probe.target = np.log((albedo * light)[rows]) / 2.2 + rng.normal(0, 0.01, len(rows))
    radius_mm = 2.4
    places = places_mm(radius_mm)
    visible = probe.visible(places)
    found = LightMap.of(probe, probe.fit(Hypothesis()), places, visible)
    apart_mm = np.linalg.norm(found.places_mm[:, None] - guides_mm, axis=2)
    assert found.share[apart_mm.min(axis=1) < radius_mm].sum() > 0.8
    for start_mm, within_mm in zip(found.guides_mm(len(guides_mm)), (1.2, 0.6), strict=True):
        apart_mm = np.linalg.norm(start_mm[:, None] - guides_mm, axis=2)
        assert apart_mm.min(axis=0).max() < within_mm


@pytest.mark.parametrize("spread", [0.0, 1e-6, 10.0])
def test_a_map_of_the_light_is_one_whatever_the_photos_show(example, spread):
    probe, radius_mm = copy.copy(example), 2.4
    probe.target = spread * np.random.default_rng(3).normal(size=len(probe))
    places = places_mm(radius_mm)
    visible = probe.visible(places)
    visible[:: len(visible) // 1000] = False
    found = LightMap.of(probe, probe.fit(Hypothesis()), places, visible)
    assert (found.share >= 0).all() and found.share.sum() == pytest.approx(1)
    assert all(np.isfinite(start_mm).all() for start_mm in found.guides_mm(3))


def test_a_pixel_that_shows_light_is_not_taken_to_lie_in_full_shadow(example):
    assert not example.lit(BESIDE.guides_mm, shadows=True).all()
    cast, uncast = example.fit(BESIDE), example.fit(replace(BESIDE, shadows=False))
    np.testing.assert_array_equal(cast.design.columns, uncast.design.columns)


def test_what_shows_light_is_not_taken_to_turn_away_from_it_unless_other_tissue_lights_it(example):
    far = Hypothesis(guides_mm=((60.0, 0.0, 0.0),))
    towards = np.array(far.guides_mm) - example.points_mm
    cos = (towards * example.normals).sum(axis=1) / np.linalg.norm(towards, axis=1)
    away = cos < 0
    assert away.any() and not away.all()
    np.testing.assert_array_equal(example.lit(far.guides_mm, shadows=False), ~away)
    alone = log_light(example, far)
    np.testing.assert_allclose(alone.cos_i[0], np.maximum(cos, LEAST_COS), atol=1e-6)
    among = log_light(example, replace(far, bounced=Surroundings(example, Patches(example)).bounced(far)))
    np.testing.assert_allclose(among.cos_i[0], np.maximum(cos, 0), atol=1e-6)


def test_shadows_are_told_by_pixels_that_show_no_light(example):
    cast, uncast = example.fit(BESIDE), example.fit(replace(BESIDE, shadows=False))
    hidden = ~example.lit(BESIDE.guides_mm, shadows=True)
    samples = example.samples[torch.from_numpy(np.flatnonzero(hidden))]
    black = replace(samples, color=torch.zeros_like(samples.color))
    probe = copy.copy(example)
    probe.dark = Sightings(samples, example.vertex[hidden], example.twin, example.caster)
    assert probe.told_by_shadows(cast, uncast).gain_db < 0
    every = [np.repeat(x, 3, axis=0) for x in (np.arange(len(black)), example.vertex[hidden])]
    probe.dark = Sightings(black[torch.from_numpy(every[0])], every[1], example.twin, example.caster)
    assert probe.told_by_shadows(cast, uncast).gain_db > 0


def test_where_nothing_is_judged_nothing_is_gained_or_lost():
    verdict = verdict_of(np.zeros(5), 0.0)
    assert (verdict.gain_db, verdict.sigmas) == (0.0, 0.0)


@pytest.mark.parametrize("bounces", [False, True])
@pytest.mark.parametrize("vignetting", [False, True])
def test_many_sets_of_guides_have_the_columns_of_each_alone(example, bounces, vignetting):
    guides_mm = np.float32([[4, 0, 0], [-3, 1, 0], [0, -30, -1]])
    sets_mm = guides_mm[[[0, 1], [2, 1], [0, 2]]]
    bounced = Surroundings(example, Patches(example)).bounced(Hypothesis()) if bounces else None
    light = Hypothesis(shadows=True, vignetting=vignetting, bounced=bounced)
    base = example.fit(light)
    found = example.columns(light, base, sets_mm, example.visible)
    for set_mm, columns in zip(sets_mm, found, strict=True):
        one = replace(light, guides_mm=tuple(map(tuple, set_mm.tolist())))
        np.testing.assert_allclose(columns, example.linearised(one, base).columns, atol=1e-4)


def test_what_several_guides_see_is_what_each_sees(example):
    guides_mm = np.float32([[4, 0, 0], [-3, 1, 0], [0, -30, -1]])
    each = [example.visible(guide_mm[None])[:, 0] for guide_mm in guides_mm]
    np.testing.assert_array_equal(example.visible(guides_mm), np.stack(each, axis=1))

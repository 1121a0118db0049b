"""What the probe tells of light and tissue, on the geometry of a real walk through a colon."""

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from independent.light import burley, ggx

from endotwin.config import STANDARD
from endotwin.evidence.decide import LEAST
from endotwin.evidence.probe import Hypothesis, Probe
from endotwin.evidence.sightings import Sightings
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
    assert not probe.compare(plain, probe.fit(Hypothesis(vignetting=True))).worth(LEAST["vignetting"])


def test_a_pixel_that_shows_light_is_not_taken_to_lie_in_full_shadow(example):
    assert not example.lit(BESIDE.guides_mm).all()
    cast, uncast = example.fit(BESIDE), example.fit(replace(BESIDE, shadows=False))
    np.testing.assert_array_equal(cast.design.columns, uncast.design.columns)


def test_shadows_are_told_by_pixels_that_show_no_light(example):
    cast, uncast = example.fit(BESIDE), example.fit(replace(BESIDE, shadows=False))
    hidden = ~example.lit(BESIDE.guides_mm)
    samples = example.samples[torch.from_numpy(np.flatnonzero(hidden))]
    black = replace(samples, color=torch.zeros_like(samples.color))
    probe = copy.copy(example)
    probe.dark = Sightings(samples, example.vertex[hidden], example.twin, example.caster)
    assert probe.told_by_shadows(cast, uncast).gain_db < 0
    every = [np.repeat(x, 3, axis=0) for x in (np.arange(len(black)), example.vertex[hidden])]
    probe.dark = Sightings(black[torch.from_numpy(every[0])], every[1], example.twin, example.caster)
    assert probe.told_by_shadows(cast, uncast).gain_db > 0

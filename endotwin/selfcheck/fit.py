"""The fit: what it cannot know it says, and what it finds does not depend on chance."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import scipy.stats
import torch

from endotwin.config import FitConfig
from endotwin.evaluation import evaluate
from endotwin.pipeline import fit_twin, fuse_twin
from endotwin.pixels.samples import Samples
from endotwin.pixels.start import PRIOR, closed_form
from endotwin.selfcheck.finding import Check, Finding
from endotwin.selfcheck.tube import Tube, flight
from endotwin.twin import Twin

VERTICES, SIGHTINGS = 400, 20_000
GAMMA, CONE, FALLOFF = 0.40, 1.6, 2.25
"""Far enough from the prior that keeping it shows."""

SEEDS = 3
SCENE = Tube(width=96)
FEW_PIXELS = FitConfig(pixels=40_000)
"""Fewer than the scene has, so that the seed decides which."""


def sightings(**fixed: float | str) -> Samples:
    """Photos of Lambertian vertices, 8 bit with noise of one step.

    ``fixed`` values of cos, cos_axis or distance are the same in all; distance="cos_axis" makes it
    20 mm/cosθ.
    """
    generator = np.random.default_rng(0)

    def drawn(name: str, low: float, high: float) -> np.ndarray:
        return np.full(SIGHTINGS, fixed[name]) if name in fixed else generator.uniform(low, high, SIGHTINGS)

    cos, cos_axis = drawn("cos", 0.25, 0.95), drawn("cos_axis", 0.55, 1)
    along = fixed.get("distance") == "cos_axis"
    distance = 20 / cos_axis if along else drawn("distance", 12, 40)
    albedo = generator.uniform(0.2, 0.8, (VERTICES, 3))
    vertex = np.sort(generator.integers(0, VERTICES, SIGHTINGS))
    strength = 300 * cos_axis**CONE / distance**FALLOFF * cos * 2
    shown = np.clip(albedo[vertex] * strength[:, None], 0, 1) ** GAMMA
    shown = np.clip(shown + generator.normal(0, 1 / 255, shown.shape), 0, 1)
    number = torch.arange(SIGHTINGS, dtype=torch.int32)
    return Samples(
        triangle=torch.from_numpy(vertex),
        barycentric=torch.tensor([[0.8, 0.1, 0.1]]).repeat(SIGHTINGS, 1),
        cos=torch.from_numpy(cos).float(),
        sin2=torch.from_numpy(1 - cos**2).float(),
        log_cos_axis=torch.from_numpy(np.log(cos_axis)).float(),
        log_distance=torch.from_numpy(np.log(distance)).float(),
        color=torch.from_numpy(np.uint8(shown * 255 + 0.5)),
        frame=number,
        pixel=number,
    )


def untold() -> Iterator[Finding]:
    """Columns of the closed form that the photos do not fill: named, kept at the prior, the rest right."""
    vertex = np.arange(VERTICES)
    fan = np.stack([vertex, (vertex + 1) % VERTICES, (vertex + 2) % VERTICES], axis=1)
    nothing = {"distance": 20.0, "cos_axis": 0.9, "cos": 0.6}
    for name, fixed, held in (
        ("nothing lacking", {}, ()),
        ("one distance", {"distance": 20.0}, ("q",)),
        ("one angle from the axis", {"cos_axis": 0.9}, ("n",)),
        ("one distance and one angle", {"distance": 20.0, "cos_axis": 0.9}, ("n", "q")),
        ("one of each", nothing, ("n", "q", "gamma")),
    ):
        start = closed_form(sightings(**fixed), fan, VERTICES)
        found = {"n": start.light.n, "q": start.light.q, "gamma": start.response.gamma}
        truth = {"n": CONE, "q": FALLOFF, "gamma": GAMMA}
        right = start.undetermined == held and all(abs(found[key] - PRIOR[key]) < 1e-12 for key in held)
        errors = [abs(found[key] / truth[key] - 1) for key in found if key not in held]
        worst = 100 * max(errors, default=0) if right else math.nan
        yield Finding(f"Closed form, {name}: error of what is told", worst, 3, unit="%")
    start = closed_form(sightings(distance="cos_axis"), fan, VERTICES)
    told = len(start.undetermined) == 1 and start.undetermined[0] in ("n", "q")
    # d = 20/cosθ: light varies as cos^(n + q), whichever of the two is held.
    error = abs((start.light.n + start.light.q) / (CONE + FALLOFF) - 1) if told else math.nan
    yield Finding("Closed form, d and θ co-linear: error of n + q", 100 * error, 3, unit="%")


def spread(twins: list[Twin], decibel: float, percent: float) -> Iterator[Finding]:
    """How much fits of the same photos with other seeds differ, and by how much they may."""
    psnr = [evaluate(twin).psnr_covered for twin in twins]
    gamma = [twin.response.gamma for twin in twins]
    yield Finding(f"{len(twins)} seeds: spread of PSNR", float(np.ptp(psnr)), decibel, unit="dB")
    yield Finding(
        f"{len(twins)} seeds: spread of γ", 100 * float(np.ptp(gamma) / np.mean(gamma)), percent, unit="%"
    )


def seeds() -> Iterator[Finding]:
    """A third of the pixels of a small scene, drawn with other seeds, and with the same."""
    with tempfile.TemporaryDirectory() as folder:
        fused = fuse_twin(SCENE.write(Path(folder) / "tube", flight(12)))
        twins = [fit_twin(fused, seed=seed, config=FEW_PIXELS) for seed in (*range(SEEDS), 0)]
        yield from spread(twins[:-1], 1.0, 2)
    one, again = twins[0], twins[-1]
    maps, others = one.materials.per_vertex, again.materials.per_vertex
    differ = sum(int((maps[name] != others[name]).sum()) for name in maps)
    differ += (one.light, one.response) != (again.light, again.response)
    yield Finding("Fit again with the same seed: values that differ", differ, 0)


def draws() -> Iterator[Finding]:
    """Pixels are drawn evenly: a chi-squared test of how many come from each tenth of them."""
    samples = sightings()
    tenth = torch.arange(SIGHTINGS) * 10 // SIGHTINGS
    counts = np.zeros(10)
    for seed in range(50):
        chosen = samples.thinned(SIGHTINGS // 4, np.random.default_rng(seed)).frame.long()
        counts += np.bincount(tenth[chosen].numpy(), minlength=10)
    # Drawn without replacement, a count varies by 1 − 1/4 of what Poisson's would.
    statistic = ((counts - counts.mean()) ** 2 / counts.mean()).sum() / (1 - 1 / 4)
    yield Finding(
        "Drawing of pixels: chi-squared p-value", scipy.stats.chi2.sf(statistic, 10), 0.01, at_least=True
    )


CHECKS: tuple[Check, ...] = (untold, draws, seeds)

"""Normals that the photos correct."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import tube_twin

import endotwin
from endotwin.cameras import Pinhole
from endotwin.config import FitConfig
from endotwin.effects import FITTED, Effects
from endotwin.fit import fit
from endotwin.fit.gauss_newton import GaussNewton
from endotwin.fit.tilt import Tilter, falling_on
from endotwin.surface.vectors import unit

pytestmark = pytest.mark.slow

DISTURBED_DEG = 1.0


@pytest.fixture(scope="module")
def meshed(fused) -> endotwin.Twin:
    """The unfitted twin of the bundled example at half its size."""
    return fused(0.5)


@pytest.fixture(scope="module")
def fitted(meshed) -> list[endotwin.Twin]:
    """Fitted without and with tilts, from normals that are off by DISTURBED_DEG along each axis."""
    off = np.radians(DISTURBED_DEG) * np.random.default_rng(0).normal(size=meshed.surface.normals.shape)
    normals = unit((meshed.surface.normals + off).astype(np.float32))
    disturbed = replace(meshed, surface=replace(meshed.surface, normals=normals))
    torch.set_num_threads(1)
    plain = dict.fromkeys(set(FITTED) - {"specular"}, "off")
    configs = (FitConfig(pixels=400_000, steps=1, tilts=tilts) for tilts in (0, 2))
    return [fit(disturbed, config, effects=plain) for config in configs]


def test_tilts_bring_the_rendering_nearer_to_photos_that_the_fit_never_saw(fitted):
    untilted, tilted = (endotwin.evaluate(twin) for twin in fitted)
    assert tilted.psnr_covered > untilted.psnr_covered + 0.3
    assert tilted.mean("ssim_covered") > untilted.mean("ssim_covered")


def test_effects_that_are_forced_off_are_not_judged(fitted):
    for name in ("coat", "tone", "film", "sparkle", "gain", "interreflection", "profile", "vignetting"):
        assert (fitted[0].decisions[name].state, fitted[0].decisions[name].reason) == ("off", "forced off")


def test_with_the_true_materials_disturbed_normals_are_found_again():
    twin = tube_twin.fitted(tube_twin.seen(tube_twin.surface(fold_mm=2.0)))
    twin = replace(twin, materials=replace(twin.materials, metallic=0 * twin.materials.metallic))
    camera = Pinhole(384, 288, 232.0, 232.0, 191.5, 143.5)
    surface = twin.surface
    poses = np.stack([tube_twin.pose(s) for s in np.linspace(0.3, 0.7, 12)])
    samples, state = tube_twin.photographed(twin, camera, poses), tube_twin.state_of(twin)
    solver = GaussNewton(samples, surface.triangles, state.operator)
    off = np.radians(0.5) * np.random.default_rng(0).normal(size=surface.normals.shape)
    disturbed = unit((surface.normals + off).astype(np.float32))
    tilter = Tilter(solver, state, Effects())
    found = tilter.tilted(tilter.tilted(disturbed))
    seen = np.bincount(surface.triangles[samples.triangle.numpy()].ravel(), minlength=len(found)) > 60

    def off_deg(normals: np.ndarray) -> float:
        cos = np.einsum("va,va->v", normals, surface.normals)[seen]
        return float(np.degrees(np.arccos(np.clip(cos, -1, 1))).mean())

    assert off_deg(found) < 0.85 * off_deg(disturbed)


def test_light_falls_on_new_normals_as_on_a_surface_that_had_them():
    twin = tube_twin.fitted(tube_twin.seen(tube_twin.surface(fold_mm=2.0)))
    off = np.radians(2.0) * np.random.default_rng(1).normal(size=twin.surface.normals.shape)
    surface = replace(twin.surface, normals=unit((twin.surface.normals + off).astype(np.float32)))
    camera, poses = Pinhole(64, 48, 40.0, 40.0, 31.5, 23.5), tube_twin.pose(0.5)[None]
    fallen = falling_on(surface, tube_twin.photographed(twin, camera, poses), Effects())
    expected = tube_twin.photographed(replace(twin, surface=surface), camera, poses)
    for name in ("cos", "sin2"):
        torch.testing.assert_close(getattr(fallen, name), getattr(expected, name), atol=1e-5, rtol=0)


def test_normals_stay_unit_and_without_tilts_they_stay_as_they_are(fitted):
    untilted, tilted = (twin.surface.normals for twin in fitted)
    np.testing.assert_allclose(np.linalg.norm(tilted, axis=1), 1, atol=1e-5)
    moved_deg = np.degrees(np.arccos(np.clip(np.einsum("va,va->v", untilted, tilted), -1, 1)))
    assert 0 < moved_deg.mean() < 2

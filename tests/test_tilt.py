"""Normals that the photos correct."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import tube_twin

import endotwin
from endotwin.cameras import Pinhole
from endotwin.casting import Caster
from endotwin.config import FitConfig
from endotwin.effects import Effects
from endotwin.fit import fit
from endotwin.fit.gauss_newton import GaussNewton, State, roughness_to_raw
from endotwin.fit.model import Globals
from endotwin.fit.samples import Samples
from endotwin.fit.tilt import tilted
from endotwin.hashgrid import HashOperator
from endotwin.incidence import incidence, unit
from endotwin.render import Renderer

pytestmark = pytest.mark.slow

DISTURBED_DEG = 1.0


@pytest.fixture(scope="module")
def meshed(example) -> endotwin.Twin:
    """The unfitted twin of the bundled example at half its size."""
    return endotwin.fuse_twin(example, scale=0.5)


@pytest.fixture(scope="module")
def fitted(meshed) -> list[endotwin.Twin]:
    """Fitted without and with tilts, from normals that are off by DISTURBED_DEG along each axis."""
    off = np.radians(DISTURBED_DEG) * np.random.default_rng(0).normal(size=meshed.surface.normals.shape)
    normals = unit((meshed.surface.normals + off).astype(np.float32))
    disturbed = replace(meshed, surface=replace(meshed.surface, normals=normals))
    torch.set_num_threads(1)
    return [fit(disturbed, FitConfig(pixels=400_000, steps=1, tilts=tilts)) for tilts in (0, 2)]


def test_tilts_bring_the_rendering_nearer_to_photos_that_the_fit_never_saw(fitted):
    untilted, tilted = (endotwin.evaluate(twin) for twin in fitted)
    assert tilted.psnr_covered > untilted.psnr_covered + 0.3
    assert tilted.mean("ssim_covered") > untilted.mean("ssim_covered")


def test_with_the_true_materials_disturbed_normals_are_found_again():
    twin = tube_twin.fitted(tube_twin.seen(tube_twin.surface(fold_mm=2.0)))
    twin = replace(twin, materials=replace(twin.materials, metallic=0 * twin.materials.metallic))
    camera = Pinhole(384, 288, 232.0, 232.0, 191.5, 143.5)
    surface, materials = twin.surface, twin.materials
    poses = np.stack([tube_twin.pose(s) for s in np.linspace(0.3, 0.7, 12)])
    renderer, caster, parts = Renderer(twin, camera), Caster(surface), []
    for frame, pose in enumerate(poses):
        photo = np.uint8(renderer.view(pose).color * 255 + 0.5)
        hits = caster.cast(camera, pose)
        parts.append(
            {
                **vars(incidence(hits, surface, camera, pose)),
                "triangle": hits.triangle.astype(np.int64),
                "barycentric": hits.barycentric,
                "color": photo.reshape(-1, 3)[hits.pixel],
                "frame": np.full(len(hits), frame, np.int32),
                "pixel": hits.pixel,
            }
        )
    columns = {name: torch.from_numpy(np.concatenate([part[name] for part in parts])) for name in parts[0]}
    samples = Samples(**columns)[torch.argsort(columns["triangle"], stable=True)]
    shown = torch.from_numpy(materials.base_color) ** twin.response.gamma
    rough = torch.tensor([roughness_to_raw(float(value)) for value in materials.roughness])
    mean = torch.cat([shown, rough[:, None]], dim=1).float()
    state = State(None, mean, None, Globals.of(twin.light, twin.response, materials.f0))
    solver = GaussNewton(samples, surface.triangles, HashOperator.each(len(surface.vertices_mm), 0.4))
    off = np.radians(0.5) * np.random.default_rng(0).normal(size=surface.normals.shape)
    disturbed = unit((surface.normals + off).astype(np.float32))
    flight = SimpleNamespace(open=lambda: SimpleNamespace(T_world_camera=poses))
    scene = SimpleNamespace(camera=camera, source=flight)
    found = tilted(tilted(disturbed, solver, state, scene, Effects()), solver, state, scene, Effects())
    seen = np.bincount(surface.triangles[samples.triangle.numpy()].ravel(), minlength=len(found)) > 60

    def off_deg(normals: np.ndarray) -> float:
        cos = np.einsum("va,va->v", normals, surface.normals)[seen]
        return float(np.degrees(np.arccos(np.clip(cos, -1, 1))).mean())

    assert off_deg(found) < 0.85 * off_deg(disturbed)


def test_normals_stay_unit_and_without_tilts_they_stay_as_they_are(fitted):
    untilted, tilted = (twin.surface.normals for twin in fitted)
    np.testing.assert_allclose(np.linalg.norm(tilted, axis=1), 1, atol=1e-5)
    moved_deg = np.degrees(np.arccos(np.clip(np.einsum("va,va->v", untilted, tilted), -1, 1)))
    assert 0 < moved_deg.mean() < 2

"""Tissue that no photo tells goes on from what is about it; all other stays bit for bit."""

from dataclasses import replace

import numpy as np
import pytest
import test_film
import torch
import tube_twin

import endotwin
from endotwin.effects import Effects
from endotwin.effects.film import Film as FilmEffect
from endotwin.effects.specular import Specular
from endotwin.fit.heal import extended, healed
from endotwin.render import Renderer

TUBE = test_film.tube(Effects([Specular()]))
SPOT_MM = 2.0


def spotted(photos: int) -> tuple:
    """Samples of the tube, those that shine about one vertex in the first photo, and that vertex."""
    samples = tube_twin.photographed(TUBE, TUBE.camera, test_film.POSES[:photos])
    mean = TUBE.surface.vertices_mm[TUBE.surface.triangles[samples.triangle.numpy()]].mean(axis=1)
    left = (samples.frame == 0) & (samples.pixel == 108 * TUBE.camera.width + 50)
    (centre,) = samples[left].nearest(TUBE.surface.triangles)
    apart_mm = np.linalg.norm(mean - TUBE.surface.vertices_mm[centre], axis=1)
    return samples, torch.from_numpy(apart_mm < SPOT_MM) & (samples.frame == 0), centre


def test_what_only_glints_show_is_as_the_tissue_about_it():
    samples, shines, centre = spotted(1)
    state = tube_twin.state_of(TUBE)
    even = state.raw.mean(dim=0).expand_as(state.raw).clone()
    near = np.linalg.norm(TUBE.surface.vertices_mm - TUBE.surface.vertices_mm[centre], axis=1) < SPOT_MM - 1
    spoiled = even.clone()
    spoiled[torch.from_numpy(near)] = 1.0
    found = healed(replace(state, operator=None, table=None, mean=spoiled), TUBE.surface, samples, shines).raw
    torch.testing.assert_close(found, even, rtol=0, atol=1e-4)


def test_what_another_photo_shows_without_a_glint_stays():
    samples, shines, _ = spotted(4)
    state = tube_twin.state_of(TUBE)
    assert shines.any()
    assert healed(state, TUBE.surface, samples, shines) is state
    nothing = torch.zeros(len(samples), dtype=torch.bool)
    assert healed(state, TUBE.surface, samples, nothing) is state


def ring(vertices: np.ndarray, first: int, last: int) -> np.ndarray:
    """Which of ``vertices`` lie in the rings ``first`` to ``last`` of the tube, which has 120 in each."""
    return (vertices // 120 >= first) & (vertices // 120 <= last)


def test_materials_go_on_from_what_photos_tell_as_heat_does():
    """Around a tube as straight lines between two rings, evenly beyond the last; a piece of which no photo
    tells any is as the mean of the rest."""
    mesh = TUBE.surface.triangles
    mesh = mesh[~ring(mesh, 150, 151).any(axis=1)]
    surface = replace(TUBE.surface, triangles=mesh)
    told = np.flatnonzero(ring(mesh, 20, 22).all(axis=1) | ring(mesh, 60, 62).all(axis=1))
    one = tube_twin.photographed(TUBE, TUBE.camera, test_film.POSES[:1])[:1]
    samples = replace(
        one[torch.zeros(len(told), dtype=torch.int64)],
        triangle=torch.from_numpy(told),
        barycentric=torch.full((len(told), 3), 1 / 3),
    )
    state, number = tube_twin.state_of(TUBE), np.arange(len(TUBE.surface.vertices_mm))
    at = torch.from_numpy(np.clip(number // 120, 20, 62) / 100).float()
    true = torch.stack([at, 1 - at, 2 * at, at - 1], dim=1)
    spoiled = torch.rand(true.shape, generator=torch.Generator().manual_seed(0))
    known = torch.from_numpy(ring(number, 20, 22) | ring(number, 60, 62))
    spoiled[known] = true[known]
    found = extended(replace(state, operator=None, table=None, mean=spoiled), surface, samples).raw
    joined, apart = (torch.from_numpy(ring(number, *rings)) for rings in ((0, 149), (152, 219)))
    torch.testing.assert_close(found[known], true[known], rtol=0, atol=0)
    torch.testing.assert_close(found[joined], true[joined], rtol=0, atol=1e-4)
    mean = true[known].mean(dim=0)
    torch.testing.assert_close(found[apart], mean.expand(int(apart.sum()), 4), rtol=0, atol=1e-3)


@pytest.mark.slow
def test_highlights_of_a_single_photo_are_a_film_and_not_white_tissue(tmp_path):
    twin = test_film.tube(Effects([Specular(), FilmEffect(roughness=test_film.ROUGHNESS)]))
    twin = replace(twin, materials=replace(twin.materials, film=test_film.wet(twin)))
    pose = test_film.POSES[[test_film.HELD_OUT]]
    recorded = test_film.recorded(tmp_path / "sequence", twin, pose)
    fitted = endotwin.fit_twin(tube_twin.unfitted(replace(recorded, effects=Effects())), align="off")
    assert fitted.decisions["film"].state == "on"
    dry = [
        Renderer(replace(each, effects=each.effects.without(["film"]))).view(pose[0]).color
        for each in (twin, fitted)
    ]
    wet = Renderer(twin).view(pose[0]).color
    glints = (wet - dry[0]).min(axis=2) > 0.2
    assert glints.sum() > 50
    assert np.abs(dry[1] - dry[0])[glints].mean() < 0.2 * np.abs(wet - dry[0])[glints].mean()

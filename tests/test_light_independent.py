"""endotwin's light and lobes against the independent renderer's formulas, point by point."""

import math

import numpy as np
import pytest
import torch
from independent.gloss import Gloss
from independent.light import Lamp, burley, dot, ggx

from endotwin.light import shading
from endotwin.light.forward import Lobes
from endotwin.light.guides import AT_LENS, COSINE, EXPONENTIAL, guided
from endotwin.surface.vectors import unit

BESIDE = ((3.2, 0.5, 0.0), (-2.8, 2.7, -1.0), (-1.3, -3.1, 0.0))


@pytest.fixture
def points() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points in front of the lens, normals that face it, and roughnesses."""
    rng = np.random.default_rng(0)
    points_mm = rng.uniform([-15, -15, 8], [15, 15, 60], (4000, 3)).astype(np.float32)
    normals = unit(unit(-points_mm) + 0.6 * rng.normal(size=points_mm.shape).astype(np.float32))
    facing = dot(normals, -points_mm) > 0
    return points_mm[facing], normals[facing], rng.uniform(0.25, 0.8, facing.sum()).astype(np.float32)


@pytest.mark.parametrize("guides_mm", [AT_LENS, BESIDE], ids=["at the lens", "beside it"])
@pytest.mark.parametrize("profile", [COSINE, EXPONENTIAL], ids=["cosine", "exponential"])
def test_light_and_lobes_are_those_of_an_independent_renderer(points, guides_mm, profile) -> None:
    points_mm, normals, roughness = points
    lamp = Lamp(L0=300, n=2.3, q=2, exponential=profile == EXPONENTIAL, guides_mm=guides_mm)
    to_eye = unit(-points_mm)
    lit = guided(points_mm, normals, np.asarray(guides_mm), profile)
    rough, cos_o = torch.from_numpy(roughness), torch.from_numpy(dot(normals, to_eye))
    for k in range(len(guides_mm)):
        strength, to_light = lamp.arriving(k, points_mm)
        diffuse = strength * burley(normals, to_light, to_eye, roughness)
        glossy = strength * ggx(normals, to_light, to_eye, roughness, 0.04)
        log_light = shading.log_spotlight(
            math.log(300 / len(guides_mm)), 2.3, 2.0, lit.log_axis[:, k], lit.log_distance[:, k]
        )
        arriving = torch.exp(log_light) * lit.cos_i[:, k]
        lobe = shading.burley(lit.cos_i[:, k], cos_o, lit.cos_d[:, k], rough)
        shine = shading.specular(
            lit.cos_i[:, k], cos_o, lit.sin2_m[:, k], lit.cos_d[:, k], rough, torch.tensor(0.04)
        )
        np.testing.assert_allclose((arriving * lobe).numpy(), diffuse, rtol=1e-3, atol=1e-6)
        np.testing.assert_allclose((arriving * shine).numpy(), glossy, rtol=5e-3, atol=1e-6)


@pytest.mark.parametrize("f0", [0.02, 0.04])
def test_even_surroundings_shine_as_the_lobes_integral_says(f0) -> None:
    cos, roughness = (grid.ravel() for grid in np.meshgrid(np.linspace(0.1, 1, 9), np.linspace(0.1, 0.9, 9)))
    found = shading.specular_of_even_light(torch.from_numpy(cos), torch.from_numpy(roughness), f0).numpy()
    np.testing.assert_allclose(found, Gloss(f0).at(cos, roughness), atol=0.005)


def test_a_coat_reflects_even_surroundings_as_a_film_of_water_does_and_hides_as_much_beneath_it() -> None:
    cos, roughness = np.linspace(0.2, 1, 9), np.full(9, 0.4)
    wet = Lobes(0.04, coat=(0.7, 0.3, 2.0)).gloss(torch.from_numpy(cos), torch.from_numpy(roughness)).numpy()
    film, tissue = 0.7 * Gloss(0.02).at(cos, np.full(9, 0.3)), Gloss(0.04).at(cos, roughness)
    np.testing.assert_allclose(wet, np.c_[film + (1 - film) * tissue, 1 - film], atol=0.005)
    bare = Lobes(0.0).gloss(torch.from_numpy(cos), torch.from_numpy(roughness)).numpy()
    np.testing.assert_array_equal(bare, np.tile([0.0, 1.0], (9, 1)))


def test_all_that_white_lobes_send_back_is_the_mean_over_directions() -> None:
    roughness, lobes = np.array([0.3, 0.5, 0.7]), Lobes(0.04, coat=(0.5, 0.3, 2.0))
    expected = np.zeros(3)
    for cos in (np.arange(16) + 0.5) / 16:
        film = 0.5 * Gloss(0.02).at(np.full(3, cos), np.full(3, 0.3))
        expected += (film + (1 - film) * Gloss(0.04).at(np.full(3, cos), roughness)) * cos / 8
    found = lobes.glossy_albedo(torch.from_numpy(roughness)).numpy()
    np.testing.assert_allclose(found, expected, rtol=0.02)

"""What white lobes throw on of a lamp's light, against the independent renderer's facets; and what they
mirror to the camera, in closed form."""

import numpy as np
import pytest
import torch
from independent.light import Lamp
from independent.radiosity import Radiosity as Facets
from independent.shapes import revolved
from independent.wall import Wall

from endotwin.light.forward import Lobes
from endotwin.light.guides import COSINE
from endotwin.light.mirror import met_mirrored
from endotwin.light.radiosity import Radiosity
from endotwin.light.shading import F0_DIELECTRIC, ROUGHNESS_TISSUE
from endotwin.surface import Surface
from endotwin.surface.casting import Caster

N, Q = 1.5, 2.0
RADIUS_MM, LENGTH_MM, AHEAD_MM = 10.0, 80.0, 15.0


@pytest.fixture(scope="module")
def tube() -> Wall:
    """A closed tube around z; the camera sits ``AHEAD_MM`` from an end."""
    along_mm = np.r_[0.0, np.linspace(0, LENGTH_MM, 159), LENGTH_MM] - AHEAD_MM
    return revolved(np.r_[0.01, np.full(159, RADIUS_MM), 0.01], along_mm)


@pytest.fixture(scope="module")
def thrown(tube: Wall) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """z [P] of patches in mm, what white lobes throw on of a light at the lens, and what even ones would."""
    surface = Surface.from_mesh(tube.vertices_mm, tube.triangles, np.zeros_like(tube.vertices_mm))
    radiosity = Radiosity(surface, Caster(surface), cell_mm=2.0)
    pose = surface.to_local(np.eye(4)[None])[0]
    lamps = [radiosity.lamp(pose, np.zeros(3), COSINE)]
    direct, factors = radiosity.direct(lamps, N, Q), radiosity.mirror_factors(pose[:3, 3], lamps)
    glossy = float(Lobes(F0_DIELECTRIC).glossy_albedo(torch.tensor(ROUGHNESS_TISSUE)))
    z_mm = radiosity.centre_mm[:, 2] + surface.origin_mm[2]
    return z_mm, factors @ (glossy * direct[:, 0]), radiosity.form_factors @ (glossy * direct[:, 0])


def test_lobes_throw_light_where_facets_mirror_it(tube: Wall, thrown) -> None:
    """Ring by ring down a tube, from behind the lens to the far end."""
    z_mm, ours, _ = thrown
    facets = Facets(tube, np.ones((*tube.shape, 3)), np.random.default_rng(0))
    rough = np.full(len(facets.tissue), ROUGHNESS_TISSUE)
    lamp = Lamp(L0=1.0, n=N, q=Q)
    theirs = facets.mirrored(lamp, np.eye(4), rough, F0_DIELECTRIC, np.random.default_rng(1))
    rows_mm = tube.vertices_mm.reshape(*tube.shape, 3)[:, 0, 2]
    rings_mm = rows_mm[2 : 2 + 4 * facets.shape[0] : 4]
    expected = ring_means(rings_mm, theirs.reshape(facets.shape).mean(axis=1))
    assert expected.max() > 20 * expected.min()
    np.testing.assert_allclose(ring_means(z_mm, ours), expected, rtol=0.1)


def test_far_down_a_tube_they_throw_twice_what_even_lobes_would(thrown) -> None:
    z_mm, ours, even = thrown
    more = ring_means(z_mm, ours) / ring_means(z_mm, even)
    assert more[0] < 0.7
    assert more[-1] > 2


def ring_means(z_mm: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Means over rings of 6 mm."""
    edges_mm = np.arange(3 - AHEAD_MM, LENGTH_MM - AHEAD_MM, 6.0)
    ring = np.digitize(z_mm, edges_mm)
    return np.array([values[ring == k].mean() for k in range(1, len(edges_mm))])


def test_a_floor_mirrors_the_wall_where_the_law_of_reflection_says() -> None:
    """A floor z = 0 before a wall x = 10, seen from 4 above its edge: (x, y) shows the wall at height
    4·(10 − x)/x; and nothing where nothing is."""
    corners_mm = [(0, -9, 0), (10, -9, 0), (10, 9, 0), (0, 9, 0), (10, -9, 9), (10, 9, 9)]
    faces = np.array([(0, 1, 2), (0, 2, 3), (1, 4, 5), (1, 5, 2)])
    surface = Surface.from_mesh(np.array(corners_mm, float), faces, np.zeros((6, 3)))
    here = surface.origin_mm
    generator = np.random.default_rng(0)
    points = np.c_[generator.uniform(1, 9.5, 500), generator.uniform(-5, 5, 500), np.zeros(500)]
    eye, normals = np.tile([0.0, 0.0, 4.0], (500, 1)), np.tile(np.float32([0, 0, 1]), (500, 1))
    triangle, barycentric = met_mirrored(
        Caster(surface), np.float32(points - here), np.float32(eye - here), normals
    )
    expected = points * (10 / points[:, :1]) + [0, 0, 4] * (10 / points[:, :1] - 1)
    shown = (np.abs(expected[:, 1]) < 9) & (expected[:, 2] < 9)
    assert 100 < shown.sum() < 400
    np.testing.assert_array_equal(triangle >= 0, shown)
    met = np.einsum("nk,nka->na", barycentric, surface.vertices_mm[surface.triangles[triangle]]) + here
    np.testing.assert_allclose(met[shown], expected[shown], atol=0.05)

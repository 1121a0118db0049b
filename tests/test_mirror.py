"""What white lobes throw on of a lamp's light, and mirror to the camera, against the independent renderer's
facets."""

import numpy as np
import pytest
import torch
from independent.light import Lamp
from independent.radiosity import Radiosity as Facets
from independent.shapes import revolved
from independent.wall import Wall

from endotwin.light.forward import Lobes
from endotwin.light.guides import COSINE
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
def facets(tube: Wall) -> Facets:
    return Facets(tube, np.ones((*tube.shape, 3)), np.random.default_rng(0))


@pytest.fixture(scope="module")
def patches(tube: Wall) -> tuple[Radiosity, np.ndarray, np.ndarray]:
    """The tube's patches, the camera's pose in their frame [4, 4], and their world z [P] in mm."""
    surface = Surface.from_mesh(tube.vertices_mm, tube.triangles, np.zeros_like(tube.vertices_mm))
    radiosity = Radiosity(surface, Caster(surface), cell_mm=2.0)
    z_mm = radiosity.centre_mm[:, 2] + surface.origin_mm[2]
    return radiosity, surface.to_local(np.eye(4)[None])[0], z_mm


@pytest.fixture(scope="module")
def thrown(patches) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """z [P] of patches in mm, what white lobes throw on of a light at the lens, and what even ones would."""
    radiosity, pose, z_mm = patches
    lamps = [radiosity.lamp(pose, np.zeros(3), COSINE)]
    direct, factors = radiosity.direct(lamps, N, Q), radiosity.mirror_factors(pose[:3, 3], lamps)
    glossy = float(Lobes(F0_DIELECTRIC).glossy_albedo(torch.tensor(ROUGHNESS_TISSUE)))
    return z_mm, factors @ (glossy * direct[:, 0]), radiosity.form_factors @ (glossy * direct[:, 0])


def test_lobes_throw_light_where_facets_mirror_it(tube: Wall, facets: Facets, thrown) -> None:
    """Ring by ring down a tube, from behind the lens to the far end."""
    z_mm, ours, _ = thrown
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


def test_lobes_show_a_camera_what_lies_where_their_facets_mirror_it(facets: Facets, patches) -> None:
    """How far down the tube that is, for rings from 12 mm on: the farther the ring, the nearer to its end."""
    radiosity, pose, z_mm = patches
    shown = radiosity.mirrored_factors(pose)
    lobe = (F0_DIELECTRIC, 1.0, np.full(len(facets.tissue), ROUGHNESS_TISSUE))
    mixture = facets.shown(np.eye(4), [lobe], np.random.default_rng(1))
    for each in (shown.sum(axis=1), mixture.sum(axis=1)):
        np.testing.assert_allclose(each[each > 0], 1, rtol=1e-5)
    middle_mm = facets._mean(facets._centres_mm)[:, 2]
    expected = ring_means(middle_mm, mixture @ middle_mm)[4:8]
    assert np.ptp(expected) > 15
    np.testing.assert_allclose(ring_means(z_mm, shown @ z_mm)[4:8], expected, atol=1.5)

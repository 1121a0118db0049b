"""Sparkles are facets of a film: together its smooth lobe, and each of them the same one in every view."""

from dataclasses import replace

import numpy as np
import pytest
import test_film
import tube_twin
from scipy.ndimage import maximum_filter
from scipy.stats import kstest

from endotwin.cameras import Pinhole
from endotwin.cameras.base import solid_angle
from endotwin.config import STANDARD
from endotwin.effects import Decision, Effects
from endotwin.effects.coat import Coat
from endotwin.effects.film import Film as FilmEffect
from endotwin.effects.offset import Offset
from endotwin.effects.shadows import Shadows
from endotwin.effects.sparkle import Sparkle
from endotwin.effects.specular import Specular
from endotwin.evaluation import evaluate
from endotwin.fit.beneath import Model
from endotwin.fit.film import Found
from endotwin.fit.lighting import Relighting
from endotwin.fit.sparkle import sparkle
from endotwin.light.film import Film
from endotwin.light.sparkle import REACH, facets_about
from endotwin.pixels.pace import Pace
from endotwin.pixels.samples import Views, gather
from endotwin.render import Renderer, sparkles
from endotwin.surface.casting import Caster

TRUE = Sparkle(weight=3.0, density=40.0, spread=0.5, roughness=0.12, size=0.006)
GUIDES = Offset(((3.0, 0.5, 0.0), (-2.0, 2.5, -1.0)))
CAMERA = Pinhole(192, 144, 116.0, 116.0, 95.5, 71.5)


def facing(s: float, turn: float = 70.0) -> np.ndarray:
    """The pose [4, 4] on the tube's axis at angle s, turned towards its wall by so many degrees."""
    pose, c = tube_twin.pose(s), np.cos(np.radians(turn))
    pose[:3, :3] = pose[:3, :3] @ [[c, 0, np.sqrt(1 - c * c)], [0, 1, 0], [-np.sqrt(1 - c * c), 0, c]]
    return pose


@pytest.fixture(scope="module")
def bare():
    return replace(tube_twin.fitted(tube_twin.surface()), camera=CAMERA)


POSE = facing(0.4)


def added(twin, effects: list, pose: np.ndarray = POSE) -> np.ndarray:
    """What ``effects`` add to the radiance [H, W] of a view."""
    others = [each for each in effects if not isinstance(each, Sparkle | Coat)]
    views = (
        Renderer(replace(twin, effects=Effects(each))).view(pose).radiance.astype(float)
        for each in (effects, others)
    )
    return np.subtract(*views)[..., 0]


@pytest.mark.slow
@pytest.mark.parametrize("light", [[], [GUIDES], [GUIDES, Shadows()]], ids=["lens", "guides", "shadows"])
def test_many_facets_shine_together_as_the_smooth_lobe_of_their_spread_does(bare, light):
    facets = added(bare, [Sparkle(weight=3.0, density=2e4, spread=0.7, roughness=0.2), *light])
    smooth = added(bare, [Coat(weight=3.0, roughness=0.7), *light])
    blocks = [image.reshape(3, 48, 3, 64).mean(axis=(1, 3)) for image in (facets, smooth)]
    assert facets.sum() == pytest.approx(smooth.sum(), rel=0.03)
    np.testing.assert_allclose(*blocks, rtol=0.1, atol=0.03 * smooth.mean())


@pytest.mark.slow
def test_how_dense_facets_are_changes_how_bright_each_is_and_not_their_mean(bare):
    poses = [facing(0.2 + 0.08 * k) for k in range(12)]
    few, many = (
        np.stack([added(bare, [Sparkle(weight=3.0, density=each, roughness=0.2)], pose) for pose in poses])
        for each in (50.0, 500.0)
    )
    assert few.mean() == pytest.approx(many.mean(), rel=0.15)
    assert few.std() > 2 * many.std()


def test_a_view_is_the_same_whatever_was_rendered_before_and_however_many_triangles_at_once(
    bare, monkeypatch
):
    twin = replace(bare, effects=Effects([Sparkle(), GUIDES]))
    first = Renderer(twin).view(POSE).radiance
    renderer = Renderer(twin)
    for s in (0.5, 0.1):
        renderer.view(facing(s))
    assert np.array_equal(renderer.view(POSE).radiance, first)
    monkeypatch.setattr(sparkles, "CHUNK", 1000)
    np.testing.assert_allclose(Renderer(twin).view(POSE).radiance, first, rtol=1e-5, atol=1e-6)


def test_a_sparkle_stays_on_the_tissue_while_the_camera_moves_and_another_shines_when_it_has(bare):
    """Its spot is where its place on the surface is seen, and as bright."""
    effect = Sparkle(weight=1.0, density=30.0, roughness=0.2, size=0.008)
    renderer = Renderer(replace(bare, effects=Effects([effect])))
    near, far = POSE.copy(), POSE.copy()
    near[:3, 3] += POSE[:3, :3] @ [0.03, -0.02, 0.02]
    far[:3, 3] += POSE[:3, :3] @ [3.0, -2.0, 2.0]
    here = added(bare, [effect])
    top = (here == maximum_filter(here, 7)) & (here > 0.02)
    view = renderer.view(POSE)
    point = np.zeros((*view.shape, 3))
    rays = CAMERA.pixel_directions[view.mask]
    point[view.mask] = rays * view.hits.distance_mm[:, None]
    world = point[top] @ POSE[:3, :3].T + POSE[:3, 3]
    kept = {}
    for name, pose in (("near", near), ("far", far)):
        there = maximum_filter(added(bare, [effect], pose), 3)
        column, row = np.rint(CAMERA.project((world - pose[:3, 3]) @ pose[:3, :3])).astype(int).T
        inside = (column >= 0) & (column < CAMERA.width) & (row >= 0) & (row < CAMERA.height)
        kept[name] = there[row[inside], column[inside]] / here[top][inside]
    assert len(kept["near"]) > 30
    assert np.mean(np.abs(kept["near"] - 1) < 0.35) > 0.85
    assert np.median(kept["far"]) < 0.1


def test_sparkles_lie_on_the_film_and_only_as_many_elsewhere_as_dry_tissue_has(bare):
    vertex = np.arange(len(bare.surface.vertices_mm) // 2, dtype=np.int32)
    film = Film(vertex, bare.surface.normals[vertex], np.zeros(len(vertex), np.float32))
    wet = replace(bare, materials=replace(bare.materials, film=film))
    on_film = film.wets(bare.surface.triangles)
    for dry in (0.0, 0.25):
        effects = Effects([FilmEffect(), Sparkle(density=200.0, dry=dry)])
        rough_mm2, whole_mm2 = (sparkles.rough_mm2(replace(each, effects=effects)) for each in (wet, bare))
        np.testing.assert_allclose(rough_mm2[on_film], whole_mm2[on_film])
        assert rough_mm2[~on_film].sum() == pytest.approx(dry * whole_mm2[~on_film].sum(), rel=1e-3)
    assert sparkles.rough_mm2(bare) is None


def test_a_score_is_that_of_the_twin_without_its_sparkles(tmp_path):
    twin = recorded(tmp_path / "smooth")
    glittering = replace(twin, effects=twin.effects.including(Sparkle(weight=3.0)))
    assert evaluate(glittering).psnr == evaluate(twin).psnr


def test_facets_lie_evenly_and_face_as_ggx_has_it():
    count, area_mm2, density, spread = 4000, 0.02, 300.0, 0.3
    everywhere = np.full((count, 3, 2), 0.0) + np.array([[-1e3, -1e3], [1e3, 1e3], [1e3, -1e3]])
    facets = facets_about(np.arange(count), np.full(count, area_mm2), everywhere, density, spread, 0.01)
    number = np.bincount(facets.row, minlength=count)
    assert number.mean() == pytest.approx(density * area_mm2, rel=0.03)
    assert number.var() == pytest.approx(density * area_mm2, rel=0.1)
    radius2 = (facets.slope.astype(float) ** 2).sum(axis=1)
    assert kstest(radius2 / (radius2 + spread**2), "uniform").pvalue > 1e-3
    assert kstest(np.arctan2(*facets.slope.T) / (2 * np.pi) + 0.5, "uniform").pvalue > 1e-3
    assert kstest(facets.share, "expon").pvalue > 1e-3
    assert facets.barycentric.sum(axis=1) == pytest.approx(1, abs=1e-6)
    for corner in range(3):  # of a uniform point in a triangle each weight is 1 − √u
        assert kstest((1 - facets.barycentric[:, corner]) ** 2, "uniform").pvalue > 1e-3


def test_two_views_find_the_same_facets_where_both_mirror_the_light():
    rng, width, spread = np.random.default_rng(0), 0.01, 0.2
    name, area_mm2 = rng.permutation(5000)[:500], np.full(500, 0.5)
    one = rng.normal(0, 0.1, (500, 1, 2)) + rng.normal(0, 0.003, (500, 3, 2))
    other = one + 0.01
    found = [facets_about(name, area_mm2, slopes, 300.0, spread, width) for slopes in (one, other)]

    def in_both(facets) -> set:
        apart = [facets.slope - each[facets.row].mean(axis=1) for each in (one, other)]
        shine = (np.linalg.norm(apart, axis=2) < REACH * width).all(axis=0)
        rows = np.column_stack([facets.row, facets.slope, facets.barycentric, facets.share])
        return set(map(tuple, rows[shine].tolist()))

    assert in_both(found[0]) == in_both(found[1]) and len(in_both(found[0])) > 500


def test_the_solid_angles_of_pixels_add_up_to_what_the_camera_sees():
    camera = Pinhole(80, 60, 40.0, 40.0, 39.5, 29.5)
    uv = np.stack(np.meshgrid(np.arange(80), np.arange(60)), axis=-1).reshape(-1, 2).astype(float)
    whole = 4 * np.arctan(1.0 * 0.75 / np.sqrt(1 + 1.0 + 0.75**2))
    assert solid_angle(camera, uv).sum() == pytest.approx(whole, rel=1e-3)


def recorded(folder, *effects):
    """A tube that is photographed along its wall, with ``effects``."""
    twin = test_film.tube(Effects([Specular(), *effects]))
    return test_film.recorded(folder, twin, np.stack([facing(0.3 + 0.003 * k, 55.0) for k in range(24)]))


def measured(twin, wanted: str):
    """What the fit says of sparkles, when it knows all else."""
    caster, state = Caster(twin.surface), tube_twin.state_of(twin)
    samples = gather(twin, Pace(STANDARD.fit), 0, caster)
    effects = twin.effects.without(["sparkle"])
    model = Model(twin, state, Relighting(twin.surface, caster, effects, samples.views), caster)
    return sparkle(Found(Decision("off", ""), model), samples.views, wanted, lambda *_: None)


@pytest.mark.slow
@pytest.mark.parametrize("true", [TRUE, replace(TRUE, spread=0.7, roughness=0.2, density=20.0)])
def test_a_fit_finds_how_dense_bright_and_wide_the_sparkles_of_the_photos_are(tmp_path, true):
    found, decision = measured(recorded(tmp_path / "rough", true), "on")
    assert decision.state == "on"
    assert found.spread == pytest.approx(true.spread, rel=0.25)
    assert found.roughness == pytest.approx(true.roughness, rel=0.25)
    assert found.size == pytest.approx(true.size, rel=0.3)
    assert np.log2(found.density / true.density) == pytest.approx(0, abs=1)
    assert np.log2(found.weight / true.weight) == pytest.approx(0, abs=1)


@pytest.mark.slow
def test_photos_without_sparkles_tell_of_none(tmp_path):
    twin = recorded(tmp_path / "smooth")
    assert measured(twin, "on")[0].weight == 0
    assert measured(twin, "auto")[0] is None and measured(twin, "off")[0] is None


def test_two_photos_are_too_few_to_tell():
    views = Views(CAMERA, np.ones((144, 192), bool), np.arange(2), np.stack([POSE, POSE]))
    found, decision = sparkle(Found(Decision("on", ""), None), views, "on", lambda *_: None)
    assert found is None and decision.state == "off" and "too few photos" in decision.reason

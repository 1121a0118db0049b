"""A film of fluid is found from its glints, shown where it is, and left off where there is none."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
import torch
import tube_sequence
import tube_twin
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import endotwin
from endotwin.cameras import Pinhole
from endotwin.config import STANDARD
from endotwin.effects import Effect, Effects
from endotwin.effects.bloom import Bloom
from endotwin.effects.coat import Coat
from endotwin.effects.film import Film as FilmEffect
from endotwin.effects.offset import Offset
from endotwin.effects.specular import Specular
from endotwin.errors import TwinError
from endotwin.fit.beneath import Model
from endotwin.fit.bloom import RADII, bloom
from endotwin.fit.by_pixels import by_pixels
from endotwin.fit.film import LEAST_DB, Found
from endotwin.fit.film import film as found_film
from endotwin.fit.glints import Glints, Lobes, gains_in_other_photos_db, pairs_in
from endotwin.fit.lighting import Relighting
from endotwin.light.film import Film, mirrored, mirrors
from endotwin.light.shading import F0_WATER
from endotwin.pixels.pace import Pace
from endotwin.pixels.samples import Samples, gather
from endotwin.render import Renderer
from endotwin.surface.casting import Caster
from endotwin.surface.vectors import unit
from endotwin.synth.job import fingerprint
from endotwin.synth.photograph import photographed
from endotwin.twin import Twin

GUIDES = Offset(((3.2, 0.5, 0.0), (-2.8, 2.7, 0.0)))
POSES = np.stack([tube_twin.pose(0.3 + 0.002 * k) for k in range(17)])
CAMERA = Pinhole(288, 216, 174.0, 174.0, 143.5, 107.5)
HELD_OUT, AWAY = 8, 16
ROUGHNESS = 0.075


def wet(twin: Twin, guides_mm=((0.0, 0.0, 0.0),)) -> Film:
    """A film on patches of the wall, each of which mirrors a guide in some view, in its middle."""
    rng = np.random.default_rng(1)
    caster, surface = Caster(twin.surface), twin.surface
    weight, normal = np.zeros(len(surface.vertices_mm), np.float32), surface.normals.copy()
    seen = np.unique(surface.triangles[caster.cast(twin.camera, POSES[HELD_OUT]).triangle])
    for centre in rng.choice(seen, 30):
        pose = surface.to_local(POSES[rng.integers(2, 15)])
        near = np.flatnonzero(np.linalg.norm(surface.vertices_mm - surface.vertices_mm[centre], axis=1) < 1.2)
        point_mm = (surface.vertices_mm[[centre]] - pose[:3, 3]) @ pose[:3, :3]
        half, _ = mirrors(point_mm.astype(np.float32), np.float32(guides_mm), 0.0, (0.0, 2.0, 2.0))
        tilt = surface.vertices_mm[near] - surface.vertices_mm[centre]
        facing = half[0] @ pose[:3, :3].T
        facing = facing[(facing @ surface.normals[centre]).argmax()]
        normal[near] = unit(facing + 0.02 * tilt)
        weight[near] = rng.uniform(0.02, 0.08)
    vertex = np.flatnonzero(weight).astype(np.int32)
    return Film(vertex, normal[vertex].astype(np.float32), weight[vertex])


def recorded(folder: Path, twin: Twin, poses: np.ndarray = POSES) -> Twin:
    """``twin`` made from photos and depth maps of itself, written as a C3VD sequence."""
    folder.mkdir()
    renderer = Renderer(twin)
    for index, pose in enumerate(poses):
        view = renderer.view(pose)
        color, _ = photographed(renderer, view, pose, pose, np.random.default_rng(0))
        cv2.imwrite(str(folder / f"{index:04d}_color.png"), np.uint8(color * 255 + 0.5)[..., ::-1])
        tifffile.imwrite(
            folder / f"{index:04d}_depth.tiff", np.uint16(np.nan_to_num(view.depth_mm) / 100 * 65535)
        )
    tube_sequence.write_poses(folder / "pose.txt", poses)
    (folder / "camera.json").write_text(json.dumps(twin.camera.to_dict()))
    return replace(twin, source=replace(twin.source, path=str(folder)))


def tube(effects: Effects) -> Twin:
    twin = tube_twin.fitted(tube_twin.seen(tube_twin.surface()))
    return replace(
        twin,
        camera=CAMERA,
        effects=effects,
        materials=replace(twin.materials, metallic=0 * twin.materials.metallic),
    )


def known(twin: Twin) -> tuple[Model, Samples]:
    """The model of all but film and bloom, and training pixels."""
    caster, state = Caster(twin.surface), tube_twin.state_of(twin)
    state = replace(state, shared=replace(state.shared, coat=twin.effects.get("coat")))
    samples = gather(twin, Pace(STANDARD.fit), 0, caster)
    relighting = Relighting(twin.surface, caster, twin.effects.without(["film", "bloom"]), samples.views)
    return Model(twin, state, relighting, caster), samples


def found(twin: Twin, wanted: str = "auto"):
    """What the fit says of the film, when it knows all else."""
    model, samples = known(twin)
    return found_film(model, samples, wanted, lambda *_: None)


@pytest.fixture(scope="module", params=["lens", "guides"])
def scene(request, tmp_path_factory) -> tuple[Twin, Film]:
    """A wet tube, and its film as it is found."""
    offset = [GUIDES] if request.param == "guides" else []
    twin = tube(Effects([Specular(), FilmEffect(roughness=ROUGHNESS), *offset]))
    film = wet(twin, GUIDES.guides_mm if offset else ((0.0, 0.0, 0.0),))
    twin = replace(twin, materials=replace(twin.materials, film=film))
    twin = recorded(tmp_path_factory.mktemp("film") / "sequence", twin)
    wetted = found(twin)
    return twin, wetted.film, wetted.effect, wetted.decision


@pytest.mark.slow
def test_views_between_and_beyond_the_photos_have_the_highlights_that_neighbours_tell_of(scene):
    twin, film, effect, decision = scene
    assert decision.state == "on" and decision.gain_db > 3
    dry = replace(twin, effects=twin.effects.without(["film"]))
    again = replace(
        twin, effects=twin.effects.including(effect), materials=replace(twin.materials, film=film)
    )
    for held_out in (HELD_OUT, AWAY):
        true, without, with_it = (Renderer(each).view(POSES[held_out]).color for each in (twin, dry, again))
        assert ((with_it - true) ** 2).mean() < 0.5 * ((without - true) ** 2).mean()


@pytest.mark.slow
def test_where_a_photo_met_the_mirror_direction_the_films_normal_is_known_to_half_a_degree(scene):
    twin, film, _, _ = scene
    true, guides_mm = twin.materials.film, np.float32(twin.effects.guides_mm or ((0.0, 0.0, 0.0),))
    nearest = np.full(len(true), np.pi)
    for pose in twin.surface.to_local(np.delete(POSES, [HELD_OUT, AWAY, 0], axis=0)):
        points_mm = (twin.surface.vertices_mm[true.vertex] - pose[:3, 3]) @ pose[:3, :3]
        half, _ = mirrors(points_mm.astype(np.float32), guides_mm, 0.0, (0.0, 2.0, 2.0))
        nearest = np.minimum(nearest, angles(half @ pose[:3, :3].T, true.normal[:, None]).min(axis=1))
    met = true.vertex[nearest < ROUGHNESS**2]
    _, ours, _ = np.intersect1d(film.vertex, met, return_indices=True)
    theirs = np.searchsorted(true.vertex, film.vertex[ours])
    apart = angles(film.normal[ours], true.normal[theirs])
    assert len(ours) > 40 and np.degrees(np.median(apart)) < 0.5


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Between unit vectors [..., 3], in radians."""
    return 2 * np.arcsin(np.minimum(np.linalg.norm(a - b, axis=-1) / 2, 1))


@pytest.mark.slow
def test_lobes_by_pixels_leave_less_than_by_their_means_and_of_unseen_photos_no_more(scene):
    twin, film, _, _ = scene
    model, samples = known(twin)
    based = model.based(samples)
    based, apart = based[~based.apart], based[based.apart]
    glints = Glints.of(based, film.vertex)
    by_means = glints.fitted(ROUGHNESS)
    finer = by_pixels(based, glints, by_means)

    def left(lobes: Lobes) -> float:
        mix, _, _ = pairs_in(based, film.vertex)
        shone = torch.from_numpy(mix @ lobes.radiance(glints).numpy())[:, None]
        return float(((based.shown - based.predicted(shone)) ** 2).sum())

    assert left(finer) < 0.9 * left(by_means)
    before_db, after_db = gains_in_other_photos_db(apart, film.vertex, [by_means, finer])
    assert after_db > before_db - 0.1


@pytest.mark.slow
def test_a_dry_tube_has_no_film_unless_it_is_forced_on(tmp_path):
    twin = recorded(tmp_path / "dry", tube(Effects([Specular()])))
    dry = found(twin)
    assert dry.film is None and dry.effect is None and dry.decision.state == "off"
    assert found(twin, "off").decision.reason == "forced off"


def lacquered(folder: Path, *effects: Effect) -> Twin:
    """A recording of the wall, face to face, that mirrors the light at the lens."""
    aside = np.eye(4)
    aside[:3, :3] = Rotation.from_euler("y", 80, degrees=True).as_matrix()
    coat = Coat(weight=1.0, roughness=0.15)
    return recorded(folder / "sequence", tube(Effects([Specular(), coat, *effects])), POSES @ aside)


@pytest.mark.parametrize("share, radius", [(0.3, RADII[2]), (0.15, RADII[3])])
def test_bloom_about_highlights_is_found_with_its_share_and_radius(tmp_path, share, radius):
    model, samples = known(lacquered(tmp_path, Bloom(share, radius)))
    effect, decision = bloom(Found(None, model), samples, "auto", lambda *_: None)
    assert decision.state == "on" and decision.gain_db > LEAST_DB
    assert effect.radius == radius and effect.share == pytest.approx(share, rel=0.15)
    assert bloom(Found(None, model), samples, "off", lambda *_: None)[0] is None


def test_scores_are_of_pictures_with_their_bloom(tmp_path):
    twin = lacquered(tmp_path, Bloom(0.3, 0.02))
    without = replace(twin, effects=twin.effects.without(["bloom"]))
    assert endotwin.evaluate(twin).psnr > 45 > 41 > endotwin.evaluate(without).psnr


def test_highlights_without_bloom_tell_none(tmp_path):
    model, samples = known(lacquered(tmp_path))
    assert (samples.color == 255).any()
    effect, decision = bloom(Found(None, model), samples, "auto", lambda *_: None)
    assert effect is None and decision.gain_db < LEAST_DB / 2


def test_a_film_of_weight_1_mirrors_the_light_as_the_lobe_at_the_mirror_direction_does():
    """F·D·G/(4 n·ωi n·ωo) × 2πL n·ωi with n = ωi = ωo, D = 1/(πα²)."""
    strength = torch.tensor([3.0], dtype=torch.float64)
    alpha = 0.1**2
    expected = 3 * F0_WATER / (4 * np.pi * alpha**2)
    assert float(mirrored(strength, torch.zeros(1, dtype=torch.float64), 0.1)) == pytest.approx(
        expected, rel=1e-6
    )


@settings(deadline=None)
@given(st.integers(0, 10_000))
def test_the_slopes_of_the_lobes_are_those_of_automatic_differentiation(seed):
    rng = np.random.default_rng(seed)
    count, pairs, guides = 4, 9, 2
    of_vertex = torch.from_numpy(rng.integers(0, count, pairs))
    axis = torch.from_numpy(unit(rng.normal(size=(count, 3))))
    half = torch.from_numpy(
        unit(axis.numpy()[of_vertex][:, None] + 0.02 * rng.normal(size=(pairs, guides, 3)))
    )
    strength = torch.from_numpy(rng.uniform(1, 5, (pairs, guides)))
    values = torch.from_numpy(0.01 * rng.normal(size=(count, 3)))
    glints = Glints(np.arange(count), None, of_vertex, half, strength, None, None, None, 0.45)

    def film(values: torch.Tensor) -> torch.Tensor:
        return Lobes(axis, values, 0.15).radiance(glints)

    _, slopes = Lobes(axis, values, 0.15).linearised(glints)
    jacobian = torch.autograd.functional.jacobian(film, values)[torch.arange(pairs), of_vertex]
    torch.testing.assert_close(slopes, jacobian, rtol=1e-6, atol=1e-9)


def test_a_film_lies_on_disk_with_its_twin_and_damage_to_it_is_said(tmp_path):
    twin = tube(Effects([Specular(), FilmEffect(roughness=ROUGHNESS)]))
    film = wet(twin)
    wetted = replace(twin, materials=replace(twin.materials, film=film))
    wetted.save(tmp_path / "twin")
    read = Twin.load(tmp_path / "twin").materials.film
    for name, values in vars(film).items():
        np.testing.assert_array_equal(getattr(read, name), values)
    dry = replace(twin, materials=replace(twin.materials, film=None))
    assert fingerprint(Twin.load(tmp_path / "twin")) == fingerprint(wetted) != fingerprint(dry)
    beyond = replace(film, vertex=film.vertex + len(twin.surface.vertices_mm))
    replace(twin, materials=replace(twin.materials, film=beyond)).save(tmp_path / "bad")
    with pytest.raises(TwinError, match="the film makes no sense"):
        Twin.load(tmp_path / "bad")


@pytest.mark.parametrize("strength", [0.0, 1e-30, 1e30])
def test_vertices_in_shadow_dim_or_dazzling_light_leave_no_nan(strength):
    glints = made_up(strength, shown=torch.tensor([0.0, 0.5, 1.0])[:, None].expand(3, 3))
    film = glints.fitted(0.05).film(glints)
    assert np.isfinite(film.normal).all() and np.isfinite(film.weight).all()
    assert strength or not len(film)


def test_a_ray_through_a_vertex_says_nothing_of_the_other_corners():
    """Their shares are 0 in all pixels, and what they show would be 0/0."""
    twin = tube(Effects([Specular()]))
    samples = tube_twin.photographed(twin, twin.camera, POSES[:3])
    corner = torch.zeros_like(samples.barycentric)
    corner[:, 0] = 1.0
    samples = replace(samples, barycentric=corner)
    relighting = Relighting(twin.surface, Caster(twin.surface), twin.effects, samples.views)
    model = Model(twin, tube_twin.state_of(twin), relighting, relighting._caster)
    vertex = np.unique(twin.surface.triangles[samples.triangle.numpy()])
    glints = Glints.of(model.based(samples), vertex)
    assert len(glints.shown) and glints.shown.isfinite().all() and glints.radiance.isfinite().all()


def made_up(strength: float, shown: torch.Tensor) -> Glints:
    """One vertex in three photos, of ``shown`` [3, 3], a tenth of a degree from each other."""
    half = unit(np.array([[[0, 0.002 * k, 1.0]] for k in range(3)], np.float32))
    normal = torch.tensor([[0.0, 0.0, 1.0]])
    radiance, of_vertex = torch.full((3, 3), 0.05), torch.zeros(3, dtype=torch.long)
    light = torch.full((3, 1), strength)
    return Glints(
        np.arange(1), torch.arange(3), of_vertex, torch.from_numpy(half), light, shown, radiance, normal, 0.45
    )

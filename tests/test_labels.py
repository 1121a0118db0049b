"""Labels against closed forms: a sphere and a cylinder seen from inside, and rays through the mesh."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import scenes
import tifffile
import trimesh
import tube_twin

from endotwin.cameras import Camera
from endotwin.effects import Effects
from endotwin.effects.coat import Coat
from endotwin.effects.film import Film as FilmEffect
from endotwin.effects.sparkle import Sparkle
from endotwin.effects.specular import Specular
from endotwin.errors import OptionError
from endotwin.light.film import Film
from endotwin.render import Renderer
from endotwin.render.renderer import Rays
from endotwin.surface import Surface
from endotwin.surface.casting import Caster, surface_points
from endotwin.synth import LABELS, Trajectory, Variation, parse_labels, synthesize
from endotwin.synth.encodings import ENCODINGS, encode_flow, encode_normals
from endotwin.synth.labels import (
    HIDDEN_NO,
    HIDDEN_NONE,
    HIDDEN_YES,
    MASK_FILLED,
    MASK_NONE,
    MASK_VALID,
    Labeller,
)
from endotwin.synth.run.dataset import make_job
from endotwin.twin import Twin

RADIUS_MM = 15.0


def inside_out(mesh: trimesh.Trimesh) -> Surface:
    """The mesh as a lumen's surface: triangles and normals turned inwards."""
    return tube_twin.seen(Surface.from_mesh(mesh.vertices, mesh.faces[:, ::-1], -mesh.vertex_normals))


def labelled(twin: Twin, poses: np.ndarray, camera: Camera, labels: str = "all") -> Labeller:
    trajectory = Trajectory(poses, np.arange(len(poses)) / 30, "poses")
    return Labeller(make_job(twin, trajectory, 0, parse_labels(labels), "c3vd", camera, Variation()))


def moving() -> np.ndarray:
    """Three poses of a camera that advances, drifts and turns."""
    ways = [((0, 0, -3), (0, 0.02, 1)), ((0.3, -0.2, -2.6), (0.02, 0, 1)), ((0.5, -0.5, -2), (0.05, 0.03, 1))]
    return np.stack([scenes.look(np.array(at), np.array(towards)) for at, towards in ways])


def analytic_warp(scene: scenes.Scene, camera: Camera, T_one: np.ndarray, T_other: np.ndarray) -> tuple:
    """Depth and flow of every pixel by the scene's equation, float64 [H, W] and [H, W, 2]."""
    rays = camera.pixel_directions.reshape(-1, 3).astype(np.float64)
    points = T_one[:3, 3] + scene.distance_mm(T_one[:3, 3], rays @ T_one[:3, :3].T)[:, None] * (
        rays @ T_one[:3, :3].T
    )
    v, u = np.divmod(np.arange(len(rays)), camera.width)
    moved = camera.project((points - T_other[:3, 3]) @ T_other[:3, :3]) - np.stack([u, v], axis=1)
    depth_mm = ((points - T_one[:3, 3]) @ T_one[:3, :3])[:, 2]
    shape = (camera.height, camera.width)
    return depth_mm.reshape(shape), moved.reshape(*shape, 2)


@pytest.mark.parametrize("camera", [scenes.pinhole(), scenes.omni()], ids=["pinhole", "omni"])
@pytest.mark.parametrize("shape", ["sphere", "cylinder"])
def test_depth_and_flow_are_those_of_the_analytic_warp(shape, camera):
    if shape == "sphere":
        scene, mesh = scenes.sphere(RADIUS_MM), trimesh.creation.icosphere(6, RADIUS_MM)
    else:
        scene = scenes.cylinder(RADIUS_MM)
        mesh = trimesh.creation.cylinder(RADIUS_MM, 400, sections=720).subdivide_to_size(40)
        mesh.update_faces(np.abs(mesh.face_normals[:, 2]) < 0.5)
    poses = moving()
    labeller = labelled(tube_twin.fitted(inside_out(mesh)), poses, camera, "depth,flow,flow_forward")
    for index, other, name in ((1, 0, "flow"), (1, 2, "flow_forward")):
        images = labeller.frame(index)
        depth_mm, moved_px = analytic_warp(scene, camera, poses[index], poses[other])
        there = np.isfinite(images["depth"]) & np.isfinite(depth_mm) & (np.abs(depth_mm) < 60)
        assert there.mean() > 0.6
        assert np.abs(images["depth"] - depth_mm)[there].max() < 0.02
        near = there & (np.abs(moved_px) < 20).all(axis=-1)
        assert near.mean() > 0.3 and np.abs(moved_px[near]).max() > 2
        assert np.abs(images[name] - moved_px)[near].max() < 0.02


@pytest.fixture(scope="module")
def folded() -> tuple[Twin, np.ndarray]:
    """A tube with folds that hide each other, and three poses in it."""
    poses = np.stack([tube_twin.pose(s) for s in (0.2, 0.22, 0.235)])
    poses[1, :3, 3] += (0.4, -0.3, 0)
    return tube_twin.fitted(tube_twin.seen(tube_twin.surface(fold_mm=4.0))), poses


@pytest.mark.parametrize(("name", "other"), [("flow", 0), ("flow_forward", 2)])
def test_following_the_flow_lands_on_the_same_surface_point(folded, name, other):
    """A ray through the place where the written flow leads meets the same triangle at the same place."""
    twin, poses = folded
    labeller = labelled(twin, poses, twin.camera)
    images = labeller.frame(1)
    raw = encode_flow(images[name])
    seen = (images[f"{name}_hidden"] == HIDDEN_NO) & (raw[..., 0] > 0)
    v, u = np.nonzero(seen)
    landed = np.stack([u, v], axis=1) + raw[v, u, :2] / 65535 * 40 - 20
    renderer = Renderer(twin, threads=1)
    there = renderer.caster.cast(
        Rays(twin.camera.directions(landed).astype(np.float32)[:, None]), poses[other]
    )
    here = renderer.caster.cast(twin.camera, poses[1], seen)
    assert len(there) == len(here) > 4000
    apart_mm = np.linalg.norm(
        surface_points(twin.surface, there) - surface_points(twin.surface, here), axis=1
    )
    assert np.quantile(apart_mm, 0.999) < 0.02
    same = there.triangle == here.triangle
    assert same.mean() > 0.98
    np.testing.assert_allclose(there.barycentric[same], here.barycentric[same], atol=0.05)


def test_hidden_pixels_are_those_whose_reprojected_depth_lies_behind_the_other_frames(folded):
    twin, poses = folded
    labeller = labelled(twin, poses, twin.camera)
    one, other = labeller.frame(1), labeller.frame(0)
    v, u = np.nonzero(np.isfinite(one["depth"]))
    rays = twin.camera.directions(np.stack([u, v], axis=1).astype(float))
    points = rays * (one["depth"][v, u] / rays[:, 2])[:, None] @ poses[1][:3, :3].T + poses[1][:3, 3]
    moved = (points - poses[0][:3, 3]) @ poses[0][:3, :3]
    uv = twin.camera.project(moved)
    nearest = np.rint(uv).astype(int)
    inside = ((nearest >= 0) & (nearest < (twin.camera.width, twin.camera.height))).all(axis=1)
    depth_mm = np.nan_to_num(other["depth"], nan=1e3)
    about = [
        way(depth_mm, np.ones((3, 3)))[tuple(nearest[inside, ::-1].T)] for way in (cv2.erode, cv2.dilate)
    ]
    behind = moved[inside, 2] > about[1] + 0.5
    before = moved[inside, 2] < about[0] + 0.1
    hidden = one["flow_hidden"][v, u][inside] == HIDDEN_YES
    assert behind.sum() > 8 and before.sum() > 500
    assert hidden[behind].mean() > 0.95 and hidden[before].mean() < 0.02
    outside = ((uv < -0.5) | (uv > (twin.camera.width - 0.5, twin.camera.height - 0.5))).any(axis=1)
    assert np.all(one["flow_hidden"][v, u][outside] == HIDDEN_YES)


def test_the_first_frame_has_no_flow_back_and_the_last_none_forward(folded):
    twin, poses = folded
    labeller = labelled(twin, poses, twin.camera)
    first, last = labeller.frame(0), labeller.frame(2)
    assert not encode_flow(first["flow"]).any() and np.all(first["flow_hidden"] == HIDDEN_NONE)
    assert not encode_flow(last["flow_forward"]).any() and encode_flow(last["flow"]).any()


def test_occlusion_marks_surface_with_more_surface_behind_it(folded):
    """Against trimesh, which counts all hits of a ray."""
    twin, poses = folded
    occlusion = labelled(twin, poses, twin.camera, "occlusion").frame(1)["occlusion"]
    mesh = trimesh.Trimesh(
        twin.surface.vertices_mm + twin.surface.origin_mm, twin.surface.triangles, process=False
    )
    rng = np.random.default_rng(0)
    v, u = rng.integers(0, twin.camera.height, 300), rng.integers(0, twin.camera.width, 300)
    rays = twin.camera.directions(np.stack([u, v], axis=1).astype(float)) @ poses[1][:3, :3].T
    places, ray, _ = mesh.ray.intersects_location(np.tile(poses[1][:3, 3], (300, 1)), rays)
    near = np.linalg.norm(places - poses[1][:3, 3], axis=1) < 100
    several = np.bincount(ray[near], minlength=300) > 1
    agree = (occlusion[v, u] == 255) == several
    assert 20 < several.sum() < 280 and agree.mean() > 0.99


def test_material_labels_are_the_twins_at_the_surface_and_metallic_of_none_is_0(folded):
    twin, poses = folded
    images = labelled(twin, poses, twin.camera).frame(0)
    hits = Caster(twin.surface).cast(twin.camera, poses[0])
    for name, image in (("base_color", "albedo"), ("roughness", "roughness"), ("metallic", "metallic")):
        expected = hits.interpolate(twin.surface, getattr(twin.materials, name))
        np.testing.assert_allclose(images[image].reshape(-1, *images[image].shape[2:])[hits.pixel], expected)
    np.testing.assert_array_equal(images["triangles"].ravel()[hits.pixel], hits.triangle)


def test_diffuse_and_specular_add_up_to_the_radiance(folded):
    """Linear light is a sum: without f0 what is left is less, and equal where nothing shines."""
    twin, poses = folded
    rough = replace(twin, materials=replace(twin.materials, f0=0.0))
    images, without = (labelled(t, poses, t.camera).frame(1) for t in (twin, rough))
    averaged = Renderer(twin).view(poses[1]).averaged
    assert_alike_but_where_highlights_are_averaged(images["diffuse"], without["rgb"], averaged)
    shine = images["rgb"] - images["diffuse"]
    assert shine.min() >= -1e-6 and shine.max() > 0.02


def test_highlights_are_where_coat_film_and_sparkles_shine_and_diffuse_has_none(folded):
    twin, poses = folded
    vertex = np.arange(0, len(twin.surface.vertices_mm), 7, dtype=np.int32)
    film = Film(vertex, twin.surface.normals[vertex], np.ones(len(vertex), np.float32))
    effects = Effects([Specular(), Coat(0.8, 0.15), FilmEffect(roughness=0.1), Sparkle(1.0)])
    wet = replace(twin, materials=replace(twin.materials, film=film), effects=effects)
    images, dry = (labelled(t, poses, t.camera).frame(1) for t in (wet, twin))
    averaged = np.logical_or(*(Renderer(each).view(poses[1]).averaged for each in (wet, twin)))
    assert_alike_but_where_highlights_are_averaged(images["diffuse"], dry["diffuse"], averaged)
    np.testing.assert_allclose(images["diffuse"] + images["specular"], images["rgb"], atol=1e-6)
    shines = (images["rgb"] - images["diffuse"]).min(axis=2) > 0.1
    assert shines.any() and not shines.all()
    np.testing.assert_array_equal(images["highlights"] == 255, shines)


def assert_alike_but_where_highlights_are_averaged(
    image: np.ndarray, other: np.ndarray, averaged: np.ndarray
) -> None:
    """A sharp highlight's pixel is a mean over its area, diffuse light included."""
    np.testing.assert_array_equal(image[~averaged], other[~averaged])
    apart = np.abs(image - other).max(axis=2)
    assert (apart > 0).mean() < 0.1 and (apart > 1 / 255).mean() < 0.001 and apart.max() < 4 / 255


def test_linear_rgb_is_what_the_response_makes_the_colours_of(folded):
    twin, poses = folded
    images = labelled(twin, poses, twin.camera).frame(1)
    linear = cv2.imdecode(np.frombuffer(ENCODINGS["rgb_linear"].encode(images["rgb_linear"]), np.uint8), -1)
    assert linear.dtype == np.uint16
    again = (linear[..., ::-1] / 65535) ** twin.response.gamma
    assert np.abs(again - images["rgb"]).max() < 0.01


def test_filled_surface_is_told_from_unseen(folded):
    twin, poses = folded
    s = tube_twin.to_axis(twin.surface.vertices_mm + twin.surface.origin_mm)[0]
    surface = replace(twin.surface, filled=s > 0.6, seen_by=np.where(s > 0.6, 0, twin.surface.seen_by))
    mask = labelled(replace(twin, surface=surface), poses, twin.camera).frame(0)["mask"]
    assert set(np.unique(mask)) == {MASK_NONE, MASK_FILLED, MASK_VALID}


def test_flow_beyond_20_px_and_none_are_0_and_the_rest_reads_back():
    flow_px = np.array([[[0, 0], [-20, 20], [19.9, -3.25], [20.1, 0], [np.nan, np.nan]]])
    raw = encode_flow(flow_px)
    assert raw.dtype == np.uint16 and raw.shape == (1, 5, 3)
    np.testing.assert_allclose(raw[0, :3, :2] / 65535 * 40 - 20, flow_px[0, :3], atol=7e-4)
    assert raw[0, :3, :2].min() > 0 and not raw[0, 3:].any()


def test_a_normal_of_none_is_0_and_the_unit_vectors_read_back():
    normals = np.array([[[0, 0, 0], [0, 0, -1], [0.6, -0.8, 0]]], np.float32)
    raw = encode_normals(normals)
    assert not raw[0, 0].any()
    np.testing.assert_allclose(raw[0, 1:] / 65535 * 2 - 1, normals[0, 1:], atol=2e-5)


def test_all_labels_are_written_and_explained(folded, tmp_path):
    twin, poses = folded
    trajectory = Trajectory(poses, np.arange(3) / 30, "poses")
    synthesize(twin, trajectory, tmp_path / "d", labels=parse_labels("all"), layout="c3vd2")
    for name in parse_labels("all"):
        for image in LABELS[name]:
            folder = {"flow": "optical_flow", "occlusion": "occlusions"}.get(image, image)
            assert len(list((tmp_path / "d" / folder).iterdir())) == 3, name
    ids = tifffile.imread(tmp_path / "d" / "triangles" / "0001.tiff")
    mesh = trimesh.load(tmp_path / "d" / "surface.ply", process=False)
    np.testing.assert_array_equal(mesh.faces, twin.surface.triangles)
    assert ids.dtype == np.int32 and ids.max() < len(mesh.faces)


@pytest.mark.parametrize("text", ["", "rgb,colour", "depth rgb"])
def test_labels_that_do_not_exist_are_refused_with_those_that_do(text):
    with pytest.raises(OptionError, match="flow_forward"):
        parse_labels(text)

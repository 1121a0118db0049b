"""Fusion against scenes whose surface is known."""

import logging
import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import Delaunay

from endotwin import fusion
from endotwin.cameras import CALIBRATIONS
from endotwin.errors import OptionError, SequenceError
from endotwin.fusion import fuse
from endotwin.fusion._open3d import o3c, o3d
from endotwin.fusion.agreement import Tolerance, agreement
from endotwin.fusion.faces import distance_mm, split
from endotwin.fusion.mesh import boundary_edges, surface_of
from endotwin.fusion.patch import _delaunay
from endotwin.fusion.reconcile import reconciled
from endotwin.fusion.views import read_views
from endotwin.sequence.readers import open_sequence
from endotwin.surface.casting import Caster

VOXEL_MM = 0.5
TOLERANCE = Tolerance(0.3, 0.01)


@pytest.fixture(scope="module")
def tube(tmp_path_factory):
    return scenes.bumpy_tube().sequence(
        tmp_path_factory.mktemp("tube"), scenes.pinhole(), scenes.poses_along()
    )


@pytest.fixture(scope="module")
def fused_tube(tube):
    return fuse(tube, voxel_mm=VOXEL_MM)


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    poses = scenes.poses_all_round()
    return scenes.sphere().sequence(tmp_path_factory.mktemp("ball"), scenes.pinhole(), poses)


@pytest.fixture(scope="module")
def fused_ball(ball):
    return fuse(ball, voxel_mm=VOXEL_MM)


def world_mm(surface):
    return surface.vertices_mm + surface.origin_mm


def disagreement(sequence, surface):
    return (
        1 - agreement(sequence.camera, surface, read_views(sequence, range(len(sequence))), TOLERANCE).agrees
    )


@pytest.mark.parametrize(
    ("scene", "poses"),
    [
        (scenes.sphere(), scenes.poses_all_round()),
        (scenes.cylinder(), scenes.poses_along(4)),
        (scenes.bumpy_tube(), scenes.poses_along()),
    ],
    ids=["sphere", "cylinder", "bumpy tube"],
)
def test_mesh_lies_within_a_tenth_of_a_voxel_of_the_surface(scene, poses, tmp_path):
    surface = fuse(scene.sequence(tmp_path, scenes.pinhole(), poses), voxel_mm=VOXEL_MM)
    assert scene.off_surface_mm(world_mm(surface)).mean() < 0.1 * VOXEL_MM


def test_normals_are_unit_point_into_the_lumen_and_match_the_gradient(fused_tube):
    scene = scenes.bumpy_tube()
    seen = fused_tube.seen_by > 0
    inward = -scene.gradient(world_mm(fused_tube)[seen].astype(np.float64))
    cosine = np.einsum("va,va->v", fused_tube.normals[seen], inward) / np.linalg.norm(inward, axis=1)
    np.testing.assert_allclose(np.linalg.norm(fused_tube.normals, axis=1), 1, atol=1e-5)
    assert np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1))) < 2
    assert (cosine > 0).mean() > 0.999


def test_no_triangle_is_degenerate_and_no_vertex_unused(fused_tube):
    a, b, c = fused_tube.triangles.T
    assert ((a != b) & (b != c) & (c != a)).all()
    assert len(np.unique(fused_tube.triangles)) == len(fused_tube.vertices_mm)


def test_same_input_gives_the_same_mesh(tube, fused_tube):
    again = fuse(tube, voxel_mm=VOXEL_MM)
    for name, value in vars(fused_tube).items():
        np.testing.assert_array_equal(value, getattr(again, name), err_msg=name)


def test_a_scene_a_kilometre_from_the_origin_gives_the_same_mesh(fused_tube, tmp_path):
    far = scenes.bumpy_tube().sequence(tmp_path, scenes.pinhole(), scenes.poses_along(), shift_mm=1e6)
    surface = fuse(far, voxel_mm=VOXEL_MM)
    assert len(surface.vertices_mm) == pytest.approx(len(fused_tube.vertices_mm), rel=1e-3)
    assert (
        scenes.bumpy_tube().off_surface_mm(surface.vertices_mm + (surface.origin_mm - 1e6)).mean()
        < 0.1 * VOXEL_MM
    )


def test_coverage_on_a_sphere_counts_the_frames_that_look_there(ball, fused_ball):
    points = world_mm(fused_ball)
    seen_by = np.zeros(len(points), int)
    nearest_mm = np.full(len(points), np.inf)
    for T in ball.T_world_camera:
        uv = ball.camera.project((points - T[:3, 3]) @ T[:3, :3])
        with np.errstate(invalid="ignore"):
            inside = ((uv >= 0) & (uv <= (ball.camera.width - 1, ball.camera.height - 1))).all(axis=1)
        seen_by += inside
        distance_mm = np.linalg.norm(points - T[:3, 3], axis=1)
        nearest_mm = np.where(inside, np.minimum(nearest_mm, distance_mm), nearest_mm)
    same = seen_by == fused_ball.seen_by
    assert same.mean() > 0.99
    np.testing.assert_allclose(fused_ball.nearest_mm[same], nearest_mm[same], rtol=1e-4)


def test_photo_frames_alone_count_for_coverage(ball, fused_ball):
    surface = fuse(ball, photo_frames=[0], voxel_mm=VOXEL_MM)
    np.testing.assert_array_equal(surface.triangles, fused_ball.triangles)
    assert surface.seen_by.max() == 1
    assert 0.05 < surface.seen_by.mean() < 0.4


def test_vertices_behind_a_fold_are_not_covered(tmp_path):
    ends = np.stack([scenes.look((0, 0, -30), (0, 0, 1)), scenes.look((0, 0, 30), (0, 0, -1))])
    sequence = scenes.bumpy_tube().sequence(tmp_path, scenes.pinhole(), ends)
    surface = fuse(sequence, photo_frames=[0], voxel_mm=VOXEL_MM)
    ray_mm = world_mm(surface) - [0, 0, -30]
    distance_mm = np.linalg.norm(ray_mm, axis=1)
    hidden = (
        scenes.bumpy_tube().distance_mm(np.array([0, 0, -30.0]), ray_mm / distance_mm[:, None])
        < distance_mm - 1
    )
    assert hidden.sum() > 1000
    assert (surface.seen_by[hidden] > 0).mean() < 0.02


def test_carve_removes_a_planted_membrane_and_patch_fills_a_planted_hole(tube, fused_tube):
    centre = fused_tube.vertices_mm[fused_tube.triangles].mean(axis=1) + fused_tube.origin_mm
    hole = np.hypot(centre[:, 0] - 12, centre[:, 2] - 5) < 3
    count = len(fused_tube.vertices_mm)
    membrane = np.array([[-6, -6, 10], [6, -6, 10], [6, 6, 10], [-6, 6, 10]]) - fused_tube.origin_mm
    damaged = surface_of(
        fused_tube.origin_mm,
        np.concatenate([fused_tube.vertices_mm, membrane.astype(np.float32)]),
        np.concatenate(
            [fused_tube.triangles[~hole], [[count, count + 1, count + 2], [count, count + 2, count + 3]]]
        ),
    )
    assert disagreement(tube, damaged) > disagreement(tube, fused_tube) + 0.05
    frames = range(len(tube))
    for _ in range(2):
        damaged, _ = reconciled(tube.camera, damaged, read_views(tube, frames), TOLERANCE)
    assert disagreement(tube, damaged) < disagreement(tube, fused_tube) + 1e-3
    inner = np.hypot(*(damaged.vertices_mm + damaged.origin_mm)[:, :2].T) < 6
    near_end = np.abs((damaged.vertices_mm + damaged.origin_mm)[:, 2]) > 40
    assert not (inner & ~near_end).any()


@pytest.fixture(scope="module")
def torn_tube(fused_tube):
    """The fused tube with a hole of 3 mm radius."""
    centre = fused_tube.vertices_mm[fused_tube.triangles].mean(axis=1) + fused_tube.origin_mm
    hole = np.hypot(centre[:, 0] - 12, centre[:, 2] - 5) < 3
    return surface_of(fused_tube.origin_mm, fused_tube.vertices_mm, fused_tube.triangles[~hole])


@pytest.fixture(scope="module")
def patched_tube(tube, torn_tube):
    views = read_views(tube, range(len(tube)))
    return reconciled(tube.camera, torn_tube, views, TOLERANCE)[0]


def test_a_patch_does_not_lie_twice(tube, fused_tube, torn_tube, patched_tube):
    def area_mm2(surface):
        a, b, c = surface.vertices_mm[surface.triangles].transpose(1, 0, 2)
        return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2

    removed = area_mm2(fused_tube) - area_mm2(torn_tube)
    views = read_views(tube, range(len(tube)))
    undamaged, _ = reconciled(tube.camera, fused_tube, views, TOLERANCE)
    patched_mm2 = area_mm2(patched_tube) - area_mm2(undamaged) + removed
    assert patched_mm2 == pytest.approx(removed, rel=0.05)


def test_a_patch_is_sewn_to_the_rim_of_its_hole(fused_tube, torn_tube, patched_tube):
    def rim(surface):
        ends_mm = surface.vertices_mm[boundary_edges(surface.triangles)]
        return {ends.tobytes() for ends in ends_mm}

    hole = rim(torn_tube) - rim(fused_tube)
    assert len(hole & rim(patched_tube)) < len(hole) / 3


def test_no_edge_has_two_triangles_on_one_side(fused_tube, fused_ball, patched_tube):
    for surface in (fused_tube, fused_ball, patched_tube):
        start, end = surface.triangles, np.roll(surface.triangles, -1, axis=1)
        edges = np.stack([start.ravel(), end.ravel()], axis=1)
        assert len(np.unique(edges, axis=0)) == len(edges)


def test_hardly_a_pixel_sees_a_sheet_that_lies_on_another(tube, fused_tube):
    caster, doubled = Caster(fused_tube), []
    for pose in tube.T_world_camera:
        hits = caster.cast(tube.camera, pose)
        T_local_camera = fused_tube.to_local(pose).astype(np.float32)
        rays = tube.camera.pixel_directions.reshape(-1, 3)[hits.pixel] @ T_local_camera[:3, :3].T
        points_mm = T_local_camera[:3, 3] + rays * hits.distance_mm[:, None]
        triangle, _, distance_mm = caster.cast_rays(points_mm + 0.01 * VOXEL_MM * rays, rays)
        a, b, c = fused_tube.vertices_mm[fused_tube.triangles[triangle]].transpose(1, 0, 2)
        faces = np.einsum("na,na->n", np.cross(b - a, c - a), rays) < 0
        doubled.append((triangle != hits.triangle) & faces & (distance_mm < VOXEL_MM))
    assert np.concatenate(doubled).mean() < 0.005


@pytest.mark.parametrize("camera", [scenes.omni(), CALIBRATIONS["c3vd-v2"].scaled(0.1)], ids=["v1", "v2"])
def test_faces_cover_every_lens_pixel_with_depth(camera):
    covered = np.zeros(camera.width * camera.height, bool)
    for face in split(camera):
        covered[face.corners[0]] = True
    ahead = camera.pixel_directions[..., 2].reshape(-1) > 0.02
    assert covered[ahead].all()


def test_faces_are_let_go_once_nobody_uses_them():
    face = weakref.ref(split(scenes.omni())[0])
    assert face() is None


def test_faces_carry_depth_without_loss():
    scene, camera, T = scenes.sphere(), scenes.omni(), scenes.look((2.0, 1.0, -3.0), (0, 0, 1))
    _, depth_mm = scene.render(camera, T)
    for face in split(camera):
        carried_mm = face.depth_mm(distance_mm(camera, depth_mm))
        row, column = np.nonzero(carried_mm)
        rays = np.stack([column, row, np.ones(len(row))]) * carried_mm[row, column]
        points = (face.R_camera_face @ np.linalg.inv(face.intrinsics) @ rays).T
        world = points @ T[:3, :3].T + T[:3, 3]
        error_mm = np.abs(np.linalg.norm(world, axis=1) - 15)
        assert np.median(error_mm) < 0.01
        assert error_mm.max() < 0.3


def test_faces_do_not_blend_across_a_jump():
    camera = scenes.omni()
    steps = np.where(np.arange(camera.width) < camera.width // 2, 10.0, 40.0)
    distances = np.broadcast_to(steps.astype(np.float32), (camera.height, camera.width))
    for face in split(camera):
        carried = face.depth_mm(distances).reshape(-1)[face.pixel] / face.depth_ratio
        assert (np.isclose(carried, 10) | np.isclose(carried, 40)).all()


def test_omnidirectional_frames_fuse_to_the_surface(tmp_path):
    poses = np.stack([scenes.look((0, 0, z), (0, 0.1, 1)) for z in (-6.0, 0.0, 6.0)])
    scene = scenes.bumpy_tube()
    surface = fuse(scene.sequence(tmp_path, scenes.omni(), poses), voxel_mm=VOXEL_MM)
    assert scene.off_surface_mm(world_mm(surface)).mean() < 0.15 * VOXEL_MM


def test_voxel_follows_the_resolution_of_the_photos(tmp_path):
    poses = scenes.poses_all_round()[:2]
    coarse = fuse(scenes.sphere().sequence(tmp_path / "a", scenes.pinhole(80, 60), poses))
    fine = fuse(scenes.sphere().sequence(tmp_path / "b", scenes.pinhole(160, 120), poses))
    assert len(fine.vertices_mm) / len(coarse.vertices_mm) == pytest.approx(4, rel=0.25)


def test_noise_in_depth_does_not_tear_the_mesh(tube, fused_tube):
    def noisy(path):
        rng = np.random.default_rng(int(Path(path).stem))
        depth_mm = np.load(path)
        return (depth_mm * (1 + 0.005 * rng.standard_normal(depth_mm.shape))).astype(np.float32)

    surface = fuse(replace(tube, read_depth_mm=noisy), voxel_mm=VOXEL_MM)
    assert scenes.bumpy_tube().off_surface_mm(world_mm(surface)).mean() < 0.2 * VOXEL_MM
    assert len(surface.vertices_mm) < 1.5 * len(fused_tube.vertices_mm)


def test_a_frame_without_depth_is_skipped_and_named(tube, caplog, monkeypatch):
    def second_is_blank(path):
        depth_mm = np.load(path)
        return np.full_like(depth_mm, np.nan) if Path(path).stem == "0001" else depth_mm

    with caplog.at_level(logging.WARNING, "endotwin"):
        fuse(replace(tube, read_depth_mm=second_is_blank), frames=[0, 1], voxel_mm=1.0)
    assert [record for record in caplog.records if "0001.npy" in record.getMessage()]
    assert len(caplog.records) == 1
    caplog.clear()
    monkeypatch.setattr(fusion, "WORTH_PIXELS", 0)
    record = {}
    with caplog.at_level(logging.WARNING, "endotwin"):
        fuse(replace(tube, read_depth_mm=second_is_blank), frames=[0, 1], voxel_mm=1.0, record=record)
    assert ["0001.npy" in each.getMessage() for each in caplog.records] == [True]
    assert record == {"fused": [0], "nothing_new": 0}


@pytest.mark.parametrize(
    ("scale", "voxel_mm", "unit", "told"),
    [(0.5, 2, 1, False), (0.1, None, 1, False), (0.25, None, 0.1, True), (0.25, 2, 10, True)],
)
def test_poses_that_contradict_depth_are_told_and_coarse_voxels_are_not(
    example, caplog, scale, voxel_mm, unit, told
):
    sequence = open_sequence(example, scale=scale)
    T_world_camera = sequence.T_world_camera.copy()
    T_world_camera[:, :3, 3] *= unit
    with caplog.at_level(logging.WARNING, "endotwin"):
        fuse(replace(sequence, T_world_camera=T_world_camera), voxel_mm=voxel_mm)
    assert any("unit" in record.getMessage() for record in caplog.records) == told


def test_no_valid_depth_at_all_is_one_sentence(tube):
    blank = replace(tube, read_depth_mm=lambda path: np.full((120, 160), np.nan, np.float32))
    for voxel_mm in (None, VOXEL_MM):
        with pytest.raises(SequenceError, match="valid depth"):
            fuse(blank, voxel_mm=voxel_mm)


@pytest.mark.parametrize(
    "options",
    [
        *({"voxel_mm": value} for value in (0.0, -1.0, np.nan)),
        *({"voxel": value} for value in (0.0, -1.0)),
        {"frames": []},
    ],
)
def test_senseless_options_are_refused(tube, options):
    with pytest.raises(OptionError):
        fuse(tube, **options)


def mean_distance_mm(surface, truth: Path) -> float:
    mesh = o3d.t.io.read_triangle_mesh(str(truth))
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(mesh.vertex.positions.to(o3c.float32), mesh.triangle.indices.to(o3c.uint32))
    return float(scene.compute_distance(o3c.Tensor(world_mm(surface).astype(np.float32))).numpy().mean())


@pytest.mark.long
def test_colon_fisheye_fuses_within_a_twentieth_of_a_millimetre(data_root):
    sequence = open_sequence(data_root / "colon_fisheye")
    surface = fuse(sequence, voxel_mm=0.4, frames=range(0, len(sequence), 3))
    assert mean_distance_mm(surface, data_root / "colon_fisheye" / "truth" / "colon.ply") < 0.05


@pytest.mark.long
def test_colon_direct_disagrees_with_few_pixels(data_root):
    sequence = open_sequence(data_root / "colon_direct")
    surface = fuse(sequence, frames=range(0, 64, 4))
    seen = read_views(sequence, range(0, 64, 8))
    assert agreement(sequence.camera, surface, seen, TOLERANCE).agrees > 0.9985
    assert mean_distance_mm(surface, data_root / "colon_direct" / "truth" / "colon.ply") < 0.01


@given(seed=st.integers(0, 2**32 - 1), pixels=st.integers(1, 300), others=st.integers(0, 100))
def test_points_in_the_image_are_triangulated_as_qhull_does(seed, pixels, others):
    generator = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(np.arange(32.0), np.arange(32.0)), axis=-1).reshape(-1, 2)
    rim = grid[(grid % 31 == 0).any(axis=1)]
    uv = np.concatenate(
        [rim, generator.permutation(grid)[:pixels], np.rint(generator.uniform(0, 31, (others, 2)) * 64) / 64]
    )
    a, b, c = uv[_delaunay(uv)].transpose(1, 0, 2)
    twice_area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    assert (twice_area < 0).all()
    assert twice_area.sum() == pytest.approx(-2 * 31**2, rel=1e-6)
    assert len(twice_area) == len(Delaunay(np.unique(uv, axis=0)).simplices)


@pytest.mark.parametrize("uv", [[[3, 3]], [[3, 3], [5, 3]], [[3, 3], [4, 4], [5, 5], [6, 6]]])
def test_points_in_line_have_no_triangles(uv):
    assert _delaunay(np.array(uv, float)).shape == (0, 3)

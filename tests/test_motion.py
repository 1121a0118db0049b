"""Tissue that moves: a bent tube whose narrowing and sway are known, its labels, and what is refused."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
import tube_twin

import endotwin
import endotwin.synth
import endotwin.synth.motion.motion
from endotwin.effects import Effects
from endotwin.effects.interreflection import Interreflection
from endotwin.effects.specular import Specular
from endotwin.errors import EndotwinError, OptionError
from endotwin.light.radiosity import Radiosity
from endotwin.render import Renderer
from endotwin.surface.casting import Caster
from endotwin.surface.vectors import dot, turned_along
from endotwin.synth import Trajectory, Variation, parse_motion, prove, synthesize
from endotwin.synth.encodings import ENCODINGS
from endotwin.synth.job import Job
from endotwin.synth.labels import LABELS, Labeller, parse_labels
from endotwin.synth.motion.crossing import crossings
from endotwin.synth.motion.kinds import Breathing, Peristalsis
from endotwin.synth.run.dataset import make_job

WAVES = "peristalsis:amplitude=2,width=0.05,pulse=0.5"
TIMES_S = np.arange(3) / 10


@pytest.fixture(scope="module")
def twin() -> endotwin.Twin:
    return tube_twin.fitted(tube_twin.seen(tube_twin.surface(fold_mm=1.5)))


@pytest.fixture(scope="module")
def plain() -> endotwin.Twin:
    """A tube without folds."""
    return tube_twin.fitted(tube_twin.seen(tube_twin.surface()))


def poses() -> np.ndarray:
    return np.stack([tube_twin.pose(s) for s in (0.5, 0.51, 0.52)])


def job_of(twin: endotwin.Twin, specs: list[str], labels: str = "all", times_s: np.ndarray = TIMES_S) -> Job:
    motion = parse_motion(specs, twin)
    trajectory = motion.carried(Trajectory(poses(), times_s, "three poses"))
    names = parse_labels(labels, moving=True)
    return make_job(twin, trajectory, 0, names, "c3vd", twin.camera.scaled(2), Variation(), motion)


def test_a_tube_narrows_by_the_wave_where_it_is(plain):
    """Distances from the true axis: R − a(s), with the wave's own formula."""
    motion = parse_motion("peristalsis:amplitude=2,width=0.06,pulse=0", plain)
    surface = motion.surface(1.3)
    s, inward = tube_twin.to_axis(surface.vertices_mm + surface.origin_mm)
    radius_mm = np.linalg.norm(inward, axis=1)
    assert radius_mm.min() == pytest.approx(tube_twin.RADIUS_MM - 2, abs=0.1)
    assert radius_mm.max() == pytest.approx(tube_twin.RADIUS_MM + 1, abs=0.1)
    at_mm = np.unwrap(s) * tube_twin.BEND_MM
    narrow = radius_mm < tube_twin.RADIUS_MM - 1.8
    front_mm = at_mm[narrow].mean()
    later = motion.surface(1.5)
    s, inward = tube_twin.to_axis(later.vertices_mm + later.origin_mm)
    narrow = np.linalg.norm(inward, axis=1) < tube_twin.RADIUS_MM - 1.8
    travelled_mm = s[narrow].mean() * tube_twin.BEND_MM - front_mm
    assert abs(travelled_mm) == pytest.approx(20 * 0.2, rel=0.1)


def test_waves_keep_the_mean_radius_and_return_after_their_delay():
    waves, s_mm = Peristalsis(pulse=0.0), np.arange(-400, 500, 0.25)
    assert abs(waves.contraction_mm(s_mm, 60.0, 0.7).mean()) < 2e-3
    once, again = (waves.contraction_mm(s_mm, 60.0, t) for t in (0.7, 0.7 + waves.delay))
    np.testing.assert_allclose(once, again, atol=1e-9)


def test_breath_begins_and_ends_at_rest_and_is_deepest_in_its_middle():
    s_mm, breath = np.array([50.0]), Breathing()
    depth = [float(breath.shift_mm(s_mm, t)[0]) for t in (0, 2, 4)]
    np.testing.assert_allclose(depth, [0, 8, 0], atol=1e-9)


@pytest.mark.parametrize("spec", [WAVES, "breathing"])
def test_normals_are_those_of_the_moved_mesh(plain, spec):
    """The mesh's own normals, turned as those of the mesh at rest are beside the surface's."""
    motion = parse_motion(spec, plain)
    moved, rest = motion.surface(1.0), plain.surface

    def of_mesh(surface):
        return trimesh.Trimesh(surface.vertices_mm, surface.triangles, process=False).vertex_normals

    expected = turned_along(rest.normals.astype(float), of_mesh(rest), of_mesh(moved))
    turned_deg = np.degrees(np.arccos(np.clip(dot(expected, rest.normals.astype(float)), -1, 1)))
    off_deg = np.degrees(np.arccos(np.clip(dot(expected, moved.normals.astype(float)), -1, 1)))
    assert np.quantile(turned_deg, 0.9) > 3
    assert np.quantile(off_deg, 0.98) < 0.5


def test_all_labels_of_moving_tissue_agree(twin, tmp_path):
    job = job_of(twin, [WAVES, "breathing"])
    endotwin.synth.render_dataset(job, tmp_path / "d")
    proof = prove(tmp_path / "d")
    assert proof.holds, proof.broken
    assert len(proof.rows) == 12
    document = json.loads((tmp_path / "d" / "dataset.json").read_text())
    assert document["motion"]["peristalsis"]["amplitude"] == 2 and "breathing" in document["motion"]


@pytest.mark.slow
def test_flow_without_the_tissues_own_motion_would_not_agree(twin, tmp_path):
    """What the proof finds is the motion: with scene flow of 0, it breaks."""
    job = job_of(twin, [WAVES], "depth_exr,flow_npz,scene_flow")
    endotwin.synth.render_dataset(job, tmp_path / "d")
    assert prove(tmp_path / "d").holds
    nothing = np.zeros((job.camera.height, job.camera.width, 3))
    (tmp_path / "d" / "0001_scene_flow.exr").write_bytes(ENCODINGS["scene_flow"].encode(nothing))
    assert "flow" in [row.claim for row in prove(tmp_path / "d").rows if not row.holds]


def test_vertices_are_those_of_the_frame_and_the_ply_has_them_at_rest(twin, tmp_path):
    job = job_of(twin, [WAVES], "vertices,triangles")
    endotwin.synth.render_dataset(job, tmp_path / "d")
    rest = trimesh.load(tmp_path / "d" / "surface.ply", process=False)
    np.testing.assert_allclose(rest.vertices, twin.surface.vertices_mm + twin.surface.origin_mm, atol=1e-4)
    moved = np.load(tmp_path / "d" / "0002_vertices.npz")["vertices_mm"]
    surface = job.motion.surface(TIMES_S[2])
    np.testing.assert_allclose(moved, surface.vertices_mm + surface.origin_mm, atol=1e-4)
    assert np.abs(moved - rest.vertices).max() > 1


def test_optical_flow_of_the_pictures_follows_the_label_better_than_a_constant_velocity(twin):
    """OpenCV's DIS, which knows nothing of the twin, on rendered pictures of a camera that stands still; the
    guess is the flow of the frame before."""
    camera, count = twin.camera.scaled(4), 4
    still = np.repeat(tube_twin.pose(0.6)[None], count, axis=0)
    speckle = np.random.default_rng(0).uniform(0.4, 1.6, (len(twin.surface.vertices_mm), 1))
    base_color = np.float32(twin.materials.base_color * speckle)
    twin = replace(twin, materials=replace(twin.materials, base_color=base_color))
    motion = parse_motion("peristalsis:amplitude=1.5,width=0.05,pulse=0", twin)
    trajectory = Trajectory(still, 0.9 + np.arange(count) / 10, "still")
    names = ("rgb", "flow_forward_npz")
    labeller = Labeller(make_job(twin, trajectory, 0, names, "c3vd", camera, Variation(), motion))
    frames = [labeller.frame(index) for index in range(count)]
    dis = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    by_dis, by_guess = [], []
    for k in (1, 2):
        one, other = (cv2.cvtColor(np.uint8(255 * frames[i]["rgb"]), cv2.COLOR_RGB2GRAY) for i in (k, k + 1))
        label, before = frames[k]["flow_forward_npz"], frames[k - 1]["flow_forward_npz"]
        shown = frames[k]["flow_forward_hidden"] == 0
        moving = (
            shown & (np.linalg.norm(np.nan_to_num(label), axis=2) > 0.5) & np.isfinite(before).all(axis=2)
        )
        assert moving.sum() > 2000
        by_dis.append(np.linalg.norm(dis.calc(one, other, None) - label, axis=2)[moving])
        by_guess.append(np.linalg.norm(before - label, axis=2)[moving])
    assert np.median(np.concatenate(by_dis)) < 0.7 * np.median(np.concatenate(by_guess))


@pytest.mark.slow
def test_form_factors_at_rest_err_hardly_more_than_two_countings_of_the_moved_ones(plain):
    """Bounced light on the moved surface, with the form factors at rest and with its own, counted twice."""
    effects = Effects([Specular(), Interreflection(cell_mm=2.0)])
    twin = replace(plain, effects=effects)
    caster = Caster(parse_motion([WAVES, "breathing"], twin).surface(2.0))
    kept = Radiosity(twin.surface, Caster(twin.surface), 2.0).moved(caster)
    own, again = (Radiosity(caster.surface, caster, 2.0, seed=seed) for seed in (0, 1))
    pose = twin.surface.to_local(tube_twin.pose(0.5))

    def irradiance(radiosity):
        direct = radiosity.direct([radiosity.lamp(pose, np.zeros(3), 0.0)], 2.0, 2.0)
        return radiosity.to_vertex @ radiosity.indirect(direct, np.full((radiosity.count, 3), 0.4))[:, 0, 0]

    at_rest, then, counted_again = map(irradiance, (kept, own, again))
    assert np.linalg.norm(at_rest - then) < 2 * np.linalg.norm(counted_again - then)
    assert at_rest.mean() == pytest.approx(then.mean(), rel=0.05)
    moved, still = Renderer(twin).moved(caster), Renderer(replace(twin, surface=caster.surface))
    views = [renderer.view(tube_twin.pose(0.5)) for renderer in (moved, still)]
    np.testing.assert_array_equal(views[0].depth_mm, views[1].depth_mm)
    assert np.abs(views[0].color - views[1].color).mean() < 0.01


def test_the_camera_rides_on_the_swaying_lumen_and_keeps_its_clearance(plain):
    motion = parse_motion("breathing:follow=1", plain)
    carried = motion.carried(Trajectory(poses(), np.array([0.0, 1.0, 2.0]), "three poses"))
    np.testing.assert_allclose(carried.T_world_camera[0], poses()[0], atol=1e-9)
    assert np.linalg.norm(carried.T_world_camera[2, :3, 3] - poses()[2, :3, 3]) > 2
    for pose, time_s in zip(carried.T_world_camera, (0.0, 1.0, 2.0), strict=True):
        surface = motion.surface(time_s)
        reach = np.linalg.norm(surface.vertices_mm + surface.origin_mm - pose[:3, 3], axis=1).min()
        assert reach == pytest.approx(tube_twin.RADIUS_MM, abs=0.3)
    np.testing.assert_allclose(carried.checks["clearance_mm"], tube_twin.RADIUS_MM, atol=0.3)


@pytest.mark.parametrize("few", [40, 5000])
def test_the_clearance_is_that_of_the_nearest_vertex_wherever_the_tissue_goes(plain, few, monkeypatch):
    """Of cameras near the wall, at all depths of a breath that takes them along by half."""
    monkeypatch.setattr(endotwin.synth.motion.motion, "FEW", few)
    motion = parse_motion([WAVES, "breathing:follow=0.5"], plain)
    near_wall = np.repeat(poses()[:1], 8, axis=0)
    near_wall[:, :3, 3] += np.linspace(-4, 4, 8)[:, None] * near_wall[:, :3, 0]
    times_s = np.linspace(0, 3, 8)
    carried = motion.carried(Trajectory(near_wall, times_s, "near the wall"))
    assert len(carried) == 8
    for pose, time_s, clearance_mm in zip(
        carried.T_world_camera, times_s, carried.checks["clearance_mm"], strict=True
    ):
        surface = motion.surface(time_s)
        each_mm = np.linalg.norm(surface.vertices_mm + surface.origin_mm - pose[:3, 3], axis=1)
        assert clearance_mm == pytest.approx(each_mm.min(), abs=1e-3)


@pytest.mark.slow
def test_the_same_motion_gives_the_same_bytes_in_any_number_of_processes_and_after_a_stop(twin, tmp_path):
    job = job_of(twin, [WAVES], "rgb,depth,flow_npz,scene_flow,vertices")
    job = replace(job, shard_frames=1)
    for name, workers in (("one", 1), ("two", 2)):
        endotwin.synth.render_dataset(job, tmp_path / name, workers=workers)

    def stop(label: str, done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        endotwin.synth.render_dataset(job, tmp_path / "three", progress=stop)
    assert not (tmp_path / "three").exists() and (tmp_path / "three.partial").exists()
    endotwin.synth.render_dataset(job, tmp_path / "three")
    files = sorted(file.name for file in (tmp_path / "one").iterdir())
    for other in ("two", "three"):
        assert files == sorted(file.name for file in (tmp_path / other).iterdir())
        for name in files:
            assert (tmp_path / "one" / name).read_bytes() == (tmp_path / other / name).read_bytes(), name


def test_a_dataset_of_still_tissue_says_nothing_of_motion(twin, tmp_path):
    synthesize(twin, Trajectory(poses(), TIMES_S, "three poses"), tmp_path / "d", labels=("depth",))
    assert "motion" not in json.loads((tmp_path / "d" / "dataset.json").read_text())
    assert not {"scene_flow", "vertices"} & set(parse_labels("all"))
    assert set(parse_labels("all", moving=True, polyps=True, fluids=True)) == set(LABELS)


def test_triangles_that_pass_through_each_other_are_found():
    one, other = (trimesh.creation.icosphere(2, 5) for _ in range(2))
    other.apply_translation((4, 0.3, 0.2))
    both = trimesh.util.concatenate([one, other])
    apart = trimesh.util.concatenate([one, other.copy().apply_translation((20, 0, 0))])
    surfaces = [endotwin.Surface.from_mesh(m.vertices, m.faces, m.vertex_normals) for m in (both, apart)]
    assert len(crossings(surfaces[0])) > 20 and len(crossings(surfaces[1])) == 0


@pytest.mark.parametrize(
    ("specs", "told"),
    [
        (["swallowing"], "peristalsis or breathing"),
        (["peristalsis:height=2"], "amplitude"),
        (["peristalsis:width=0"], "width must be greater than 0"),
        (["breathing:amplitude=-1"], "between 0"),
        (["breathing:follow=2"], "follow"),
        (["breathing", "breathing:period=3"], "once"),
        (["peristalsis:amplitude=11"], "folds the tissue"),
        (["breathing:amplitude=40,wavelength=40"], "lower its amplitude"),
    ],
)
def test_motion_that_makes_no_sense_is_refused_in_a_sentence(plain, specs, told):
    with pytest.raises(EndotwinError, match=told):
        parse_motion(specs, plain).carried(Trajectory(poses(), np.array([0.0, 1.0, 2.0]), "three poses"))


def test_labels_of_motion_need_motion(plain, tmp_path):
    with pytest.raises(OptionError, match="--motion"):
        endotwin.synthesize(plain, poses(), tmp_path / "d", labels="scene_flow")

"""Photos aligned to a surface: slopes against finite differences, and what known errors come back as."""

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tube_sequence
from command_line import invoke
from scipy.spatial.transform import Rotation, Slerp

import endotwin
from endotwin.align.corrections import SHARED, Corrections
from endotwin.align.coupled import coupled
from endotwin.align.motion import adjoint, moved, twists_between
from endotwin.align.photos import read_photos
from endotwin.align.scene import SHADING_MEAN, Scene
from endotwin.align.texture import sighted
from endotwin.align.trajectory import compare
from endotwin.align.views import View
from endotwin.align.written import write_poses
from endotwin.cameras import read_camera, write_camera
from endotwin.config import STANDARD
from endotwin.errors import SequenceError, TrajectoryError
from endotwin.sequence.poses import read_c3vd_poses, read_poses, write_c3vd_poses
from endotwin.surface.casting import Caster
from endotwin.twin import Registration, Twin


def some_twists(count: int, deg: float = 1.0, mm: float = 1.0, seed: int = 0) -> np.ndarray:
    generator = np.random.default_rng(seed)
    return np.c_[generator.normal(0, np.radians(deg), (count, 3)), generator.normal(0, mm, (count, 3))]


@pytest.fixture(scope="module")
def tube(tmp_path_factory) -> Twin:
    folder = tmp_path_factory.mktemp("tube") / "sequence"
    tube_sequence.write(folder, 6, 160, 120)
    return endotwin.fuse_twin(folder)


def test_a_motion_is_the_twist_that_it_was_made_of():
    T, twists = tube_sequence.poses(5), some_twists(5)
    np.testing.assert_allclose(twists_between(T, moved(T, twists)), twists, atol=1e-12)


def test_the_adjoint_carries_a_twist_from_one_side_of_a_pose_to_the_other():
    T, twists = tube_sequence.poses(5), some_twists(5)
    carried = moved(np.eye(4)[None].repeat(5, 0), np.einsum("nij,nj->ni", adjoint(T), twists))
    np.testing.assert_allclose(carried @ T, moved(T, twists), atol=1e-9)


def test_slopes_of_corrections_are_those_of_finite_differences():
    start = Corrections.none(tube_sequence.poses(6))
    shared = np.r_[some_twists(2, 0.01, 0.01).ravel(), 0.2, 0.01, -0.01, 0.02]
    start = replace(start, shared=shared, own=some_twists(6, 0.01, 0.01, 1))
    slopes = start.slopes()
    for k in range(SHARED):
        bent = replace(start, shared=start.shared + 1e-4 * np.eye(SHARED)[k])
        turned = twists_between(start.poses, bent.poses) / 1e-4
        lens = np.tile((bent.intrinsics - start.intrinsics) / 1e-4, (6, 1))
        found = np.hstack([turned, lens])
        np.testing.assert_allclose(slopes[:, :, k], found, atol=0.01 * np.abs(found).max() + 1e-3)


def test_a_lag_of_a_whole_frame_is_the_next_pose():
    T = tube_sequence.poses(6)
    later = replace(Corrections.none(T), shared=np.r_[np.zeros(12), 1.0, np.zeros(3)]).poses
    np.testing.assert_allclose(later[:-1], T[1:], atol=1e-9)


@pytest.mark.parametrize("lag", [-0.2, 0.1, 0.2])
def test_turns_that_a_recorder_read_between_two_frames_come_back(lag):
    T = moved(tube_sequence.poses(12), some_twists(12, 1.0, 0.0))
    turns = Rotation.from_matrix(T[:, :3, :3])
    read = Slerp(np.arange(12), turns)(np.clip(np.arange(12) + lag, 0, 11))
    written = T.copy()
    written[:, :3, :3] = read.as_matrix()
    found = replace(Corrections.none(written), shared=np.r_[np.zeros(12), -lag, np.zeros(3)]).poses
    off = (Rotation.from_matrix(found[:, :3, :3]).inv() * turns).magnitude()[4:-4]
    was = (read.inv() * turns).magnitude()[4:-4]
    assert off.max() < 0.1 * was.max()


def test_slopes_of_sighted_vertices_are_those_of_finite_differences(tube):
    sequence, frame = tube.sequence(), 2
    scene = Scene.of(Caster(tube.surface), sequence.camera, 4000)
    photo, pose = read_photos(sequence, [frame])[frame], sequence.T_world_camera[frame]
    light = SHADING_MEAN
    for k, size in enumerate((3e-4, 3e-4, 3e-4, 0.01, 0.01, 0.01, 5e-4, 5e-4, 5e-4)):
        bent = [sign * size * np.eye(9)[k] for sign in (-1, 0, 1)]
        scenes = [scene.through(scene.camera.corrected(by[6:])) for by in bent]
        ends = [
            sighted(seen, photo, View.of(seen, moved(pose, by[:6]), 2.0))
            for seen, by in zip(scenes, bent, strict=True)
        ]
        common = set.intersection(*(set(end.vertex.tolist()) for end in ends))
        rows = [np.flatnonzero(np.isin(end.vertex, list(common))) for end in ends]
        low, high = (
            (end.shown - end.columns @ light)[row] for end, row in zip(ends[::2], rows[::2], strict=True)
        )
        found, told = (high - low) / (2 * size), ends[1].slopes(light)[rows[1], k]
        assert len(common) > 200
        assert np.corrcoef(found, told)[0, 1] > 0.98
        assert np.polyfit(told, found, 1)[0] == pytest.approx(1, abs=0.05)


def test_coupled_equations_are_those_in_which_the_levels_of_places_are_solved_for(monkeypatch):
    monkeypatch.setattr("endotwin.align.coupled.CHUNK", 4)
    generator = np.random.default_rng(0)
    frame, place = np.nonzero(generator.random((5, 30)) < 0.5)
    slopes, weight = generator.normal(size=(len(frame), 3)), generator.uniform(0.2, 1, len(frame))
    value = generator.normal(size=len(frame))
    mean = np.bincount(place, weight * value, 30) / np.maximum(np.bincount(place, weight, 30), 1e-12)
    matrix, right = coupled(slopes, value - mean[place], weight, frame, place, (5, 30))

    columns = np.zeros((len(frame), 15 + 30))
    columns[np.arange(len(frame))[:, None], 3 * frame[:, None] + np.arange(3)] = slopes
    columns[np.arange(len(frame)), 15 + place] = 1
    whole = np.linalg.lstsq(columns * np.sqrt(weight)[:, None], -value * np.sqrt(weight), rcond=None)[0]
    found = np.linalg.solve(matrix.reshape(15, 15), right.reshape(15))
    np.testing.assert_allclose(found, whole[:15], atol=1e-9)


def test_ate_and_rpe_are_those_of_evo():
    metrics = pytest.importorskip("evo.core.metrics")
    trajectory = pytest.importorskip("evo.core.trajectory")
    true = tube_sequence.poses(12)
    T = moved(true, some_twists(12, 0.5, 0.2))
    found = compare(T, true)
    pair = [trajectory.PosePath3D(poses_se3=list(poses)) for poses in (true, T)]
    relation = metrics.PoseRelation

    def evo(metric, paths) -> float:
        metric.process_data(tuple(paths))
        return metric.get_statistic(metrics.StatisticsType.rmse)

    frames = metrics.Unit.frames
    assert found.ate_mm == pytest.approx(evo(metrics.APE(relation.translation_part), pair))
    assert found.ate_deg == pytest.approx(evo(metrics.APE(relation.rotation_angle_deg), pair))
    assert found.rpe_mm == pytest.approx(evo(metrics.RPE(relation.translation_part, 1, frames), pair))
    assert found.rpe_deg == pytest.approx(evo(metrics.RPE(relation.rotation_angle_deg, 1, frames), pair))
    pair[1].align(pair[0])
    assert found.aligned_mm == pytest.approx(evo(metrics.APE(relation.translation_part), pair))


def test_a_motion_of_all_poses_leaves_nothing_once_it_is_undone():
    true = tube_sequence.poses(12)
    found = compare(moved(np.eye(4), np.r_[0.1, -0.2, 0.3, 4.0, 5.0, 6.0]) @ true, true)
    assert found.ate_mm > 1 and found.ate_deg == pytest.approx(np.degrees(np.sqrt(0.14)))
    assert found.aligned_mm < 1e-6 and found.aligned_deg < 1e-6


def test_trajectories_of_other_lengths_are_not_compared():
    with pytest.raises(TrajectoryError, match="one a frame"):
        compare(tube_sequence.poses(3), tube_sequence.poses(4))


def test_a_twin_keeps_where_its_photos_were_aligned_to(tube, tmp_path):
    twists = some_twists(6, 0.1, 0.1)
    rows = tuple(map(tuple, twists.tolist()))
    aligned = replace(tube, registration=Registration(rows, {"model_mm": 0.1}, intrinsics=(0.01, 0.0, 0.02)))
    aligned.save(tmp_path / "twin")
    back = Twin.load(tmp_path / "twin")
    written = tube.sequence().T_world_camera
    assert back.registration == aligned.registration
    np.testing.assert_array_equal(back.sequence().T_world_camera, aligned.sequence().T_world_camera)
    np.testing.assert_allclose(twists_between(written, back.sequence().T_world_camera), twists, atol=1e-12)
    assert back.sequence().camera == tube.camera.corrected(np.array([0.01, 0.0, 0.02]))
    assert back.at_scale(0.5).camera == tube.at_scale(0.5).camera.corrected(np.array([0.01, 0.0, 0.02]))


def test_a_sequence_that_grew_since_is_told(tube):
    short = replace(tube, registration=Registration(((0.0,) * 6,) * 5))
    with pytest.raises(SequenceError, match="5 were aligned"):
        short.sequence()


@pytest.mark.parametrize("format", ["c3vd", "tum"])
def test_corrected_poses_are_read_back(tube, tmp_path, format):
    sequence = replace(tube.sequence(), format=format)
    write_poses(tmp_path / "poses.txt", sequence)
    np.testing.assert_allclose(read_poses(tmp_path / "poses.txt")[0], sequence.T_world_camera, atol=1e-9)


@pytest.mark.parametrize("blank", [{0: 0, 4: 255}, dict.fromkeys(range(10), 255)], ids=["two", "all"])
def test_photos_that_show_nothing_ask_for_nothing(tmp_path, blank):
    tube_sequence.write(tmp_path / "tube")
    for frame, value in blank.items():
        path = str(tmp_path / "tube" / f"{frame:04d}_color.png")
        cv2.imwrite(path, np.full_like(cv2.imread(path), value))
    aligned = endotwin.align_twin(endotwin.fuse_twin(tmp_path / "tube"), "on")
    assert np.isfinite(aligned.sequence().T_world_camera).all()
    if len(blank) == 10:
        moved_by = twists_between(aligned.source.open().T_world_camera, aligned.sequence().T_world_camera)
        assert np.abs(moved_by).max() < 1e-9


def registered_wrongly(twin: Twin, folder: Path, twist: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """The example's photos beside depth of its surface at other poses, which a wrong hand-eye matrix gives,
    and through a wrong camera: what puts them right is ``twist`` [6] and ``intrinsics`` [3]."""
    import tifffile

    from endotwin.surface.casting import Caster

    sequence, caster = twin.sequence(), Caster(twin.surface)
    camera = sequence.camera.corrected(-intrinsics)
    true = sequence.T_world_camera
    written = moved(true, -twist)
    folder.mkdir()
    rays = camera.pixel_directions
    for index in range(len(sequence)):
        hits = caster.cast(camera, written[index])
        depth_mm = np.zeros(rays.shape[:2], np.float32).reshape(-1)
        depth_mm[hits.pixel] = hits.distance_mm * rays.reshape(-1, 3)[hits.pixel, 2]
        raw = np.uint16(np.clip(depth_mm / 100 * 65535, 0, 65535) + 0.5).reshape(rays.shape[:2])
        tifffile.imwrite(folder / f"{index:04d}_depth.tiff", raw)
        cv2.imwrite(str(folder / f"{index:04d}_color.png"), sequence.color(index)[..., ::-1])
    write_camera(folder / "camera.json", camera)
    write_c3vd_poses(folder / "pose.txt", written)
    return true


@pytest.mark.long
def test_a_hand_eye_error_is_found_and_held_out_photos_gain(fused, tmp_path):
    twist = np.r_[np.radians([0.1, -0.1, 0.07]), 0.2, -0.2, 0.15]
    true = registered_wrongly(fused(), tmp_path / "spoilt", twist, np.zeros(3))
    assert invoke("fuse", tmp_path / "spoilt", "-o", tmp_path / "twin") == 0
    quickly = {
        "effects": dict.fromkeys(("offset", "interreflection", "gain", "coat", "tone"), "off"),
        "config": replace(STANDARD.fit, pixels=400_000, steps=1, tilts=0),
    }
    plain = endotwin.evaluate(endotwin.fit_twin(tmp_path / "twin", align="off", **quickly))
    aligned = endotwin.fit_twin(tmp_path / "twin", **quickly)
    found, before = (compare(each, true) for each in (aligned.sequence().T_world_camera, moved(true, -twist)))
    assert found.ate_mm < before.ate_mm / 2
    assert endotwin.evaluate(aligned).psnr_covered > plain.psnr_covered + 2


@pytest.mark.long
def test_a_calibration_that_is_not_the_photos_is_put_right(fused, tmp_path, capsys):
    twin = fused()
    true_poses = registered_wrongly(twin, tmp_path / "spoilt", np.zeros(6), np.array([0.01, 0.005, 0.0]))
    write_c3vd_poses(tmp_path / "true.txt", true_poses)
    assert invoke("fuse", tmp_path / "spoilt", "-o", tmp_path / "twin") == 0
    written = "--camera", tmp_path / "camera.json", "--poses", tmp_path / "new.txt"
    assert invoke("align", tmp_path / "twin", *written, "--against", tmp_path / "true.txt") == 0
    assert "as aligned: ATE" in capsys.readouterr().out
    assert compare(read_c3vd_poses(tmp_path / "new.txt"), true_poses).ate_mm < 0.1
    found, true = read_camera(tmp_path / "camera.json"), twin.camera
    written = read_camera(tmp_path / "spoilt" / "camera.json")
    assert abs(found.fx - true.fx) < 0.5 * abs(written.fx - true.fx)


@pytest.mark.slow
def test_photos_that_lie_on_the_surface_stay(fused):
    aligned = endotwin.align_twin(fused())
    assert aligned.registration is None


@pytest.mark.long
def test_depth_maps_that_moved_with_their_photos_find_back_to_each_other(example, tmp_path):
    sequence = endotwin.open_sequence(example)
    true = sequence.T_world_camera
    wrong = moved(true, some_twists(len(true), 0.07, 0.15))
    shutil.copytree(example, tmp_path / "spoilt")
    write_c3vd_poses(tmp_path / "spoilt" / "pose.txt", wrong)
    aligned = endotwin.align_twin(endotwin.fuse_twin(tmp_path / "spoilt"))
    assert aligned.registration.with_depth
    found, before = compare(aligned.sequence().T_world_camera, true), compare(wrong, true)
    assert found.rpe_mm < before.rpe_mm / 10 and found.aligned_mm < before.aligned_mm / 10
    assert found.aligned_deg < before.aligned_deg / 3

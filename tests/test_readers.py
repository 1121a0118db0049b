"""Readers, on files that plain NumPy, Pillow and tifffile wrote here, and on every kind of bad input."""

import codecs
import json
import re
import shutil
import struct
import subprocess
import sys
import zlib
from dataclasses import asdict, replace

import cv2
import numpy as np
import OpenEXR
import pytest
import tifffile
from c3vd_folder import CAMERA, H, W, photo, truth_poses, write_c3vd
from PIL import Image
from scipy.spatial.transform import Rotation

from endotwin.cameras import CALIBRATIONS, Fisheye, Pinhole
from endotwin.errors import CameraError, OptionError, SequenceError, TrajectoryError
from endotwin.sequence.images import PNG_SIGNATURE
from endotwin.sequence.poses import read_poses, write_c3vd_poses
from endotwin.sequence.readers import FORMATS, open_sequence
from endotwin.sequence.readers.transforms import write_poses
from endotwin.sequence.sequence import Split
from endotwin.twin import Source


def png(path, array):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(array).save(path)


# --- C3VD


def test_c3vd_v1_reads_back_what_was_written(tmp_path):
    raw = np.random.default_rng(1).integers(1, 65535, (H, W)).astype(np.uint16)
    raw[0, :2] = (0, 65535)
    folder = write_c3vd(tmp_path / "c3vd", depth=[raw] * 3)
    sequence = open_sequence(folder)
    assert (sequence.format, len(sequence), sequence.camera) == ("c3vd", 3, Pinhole(W, H, 40, 41, 31.5, 23.5))
    frame = sequence.frame(2)
    np.testing.assert_array_equal(frame.color, photo(2))
    assert np.isnan(frame.depth_mm[0, :2]).all()
    np.testing.assert_allclose(frame.depth_mm[1:], raw[1:] / 65535 * 100, rtol=1e-6)
    np.testing.assert_allclose(sequence.T_world_camera, truth_poses(3), atol=1e-9)


def test_unpadded_colour_numbers_pair_with_padded_depth_in_numeric_order(tmp_path):
    folder = write_c3vd(tmp_path / "c3vd", count=13)
    for index in range(13):
        (folder / f"{index:04d}_color.png").rename(folder / f"{index}_color.png")
    sequence = open_sequence(folder)
    assert [path.name for path in sequence.color_files] == [f"{index}_color.png" for index in range(13)]
    assert [path.name for path in sequence.depth_files] == [f"{index:04d}_depth.tiff" for index in range(13)]
    np.testing.assert_array_equal(sequence.color(12), photo(12))


def test_c3vds_own_calibration_serves_where_there_is_no_camera_json(tmp_path):
    png(tmp_path / "0_color.png", np.zeros((1080, 1350, 3), np.uint8))
    tifffile.imwrite(tmp_path / "0000_depth.tiff", np.ones((1080, 1350), np.uint16))
    (tmp_path / "pose.txt").write_text(",".join(map(str, np.eye(4).T.ravel())) + "\n")
    assert open_sequence(tmp_path).camera == CALIBRATIONS["c3vd-v1"]


@pytest.mark.parametrize("names", ["{:04d}.tiff", "{:04d}_depth.tiff"])
def test_c3vd_v2_reads_its_folders_and_its_calibration(tmp_path, names):
    for index in range(2):
        png(tmp_path / "rgb" / f"{index:04d}.png", np.full((1080, 1350, 3), 9 + index, np.uint8))
        (tmp_path / "depth").mkdir(exist_ok=True)
        raw = np.full((1080, 1350), 32768, np.uint16)
        tifffile.imwrite(tmp_path / "depth" / names.format(index), raw)
    write_c3vd_poses(tmp_path / "pose.txt", truth_poses(2))
    sequence = open_sequence(tmp_path)
    assert sequence.camera == CALIBRATIONS["c3vd-v2"]
    assert sequence.color(1)[0, 0, 0] == 10
    assert sequence.depth_mm(0)[7, 7] == pytest.approx(32768 / 65535 * 100)


@pytest.mark.parametrize("compression", [None, "zlib"])
@pytest.mark.parametrize("predictor", [False, True])
def test_depth_tiffs_of_every_common_kind_decode_alike(tmp_path, compression, predictor):
    raw = np.arange(H * W, dtype=np.uint16).reshape(H, W) * 7 + 1
    folder = write_c3vd(tmp_path / "c3vd", depth=[raw] * 3)
    tifffile.imwrite(
        folder / "0000_depth.tiff", raw, compression=compression, predictor=predictor and bool(compression)
    )
    np.testing.assert_allclose(open_sequence(folder).depth_mm(0), raw / 65535 * 100, rtol=1e-6)


def test_an_lzw_tiff_is_read(tmp_path):
    raw = np.arange(H * W, dtype=np.uint16).reshape(H, W) * 7 + 1
    folder = write_c3vd(tmp_path / "c3vd")
    Image.fromarray(raw).save(folder / "0000_depth.tiff", compression="tiff_lzw")
    np.testing.assert_allclose(open_sequence(folder).depth_mm(0), raw / 65535 * 100, rtol=1e-6)


# --- transforms.json


def write_transforms(folder, poses, unit_mm=1000.0, depth_name="depth/{}.png", **top):
    """nerfstudio's layout: OpenGL cameras, positions in metres, depth in 16-bit millimetres."""
    frames = []
    for index, pose in enumerate(poses):
        png(folder / "images" / f"frame_{index}.png", photo(index))
        depth = folder / depth_name.format(f"frame_{index}")
        png(depth, np.full((H, W), 25 + index, np.uint16))
        opengl = pose.copy()
        opengl[:3, 1:3] *= -1
        opengl[:3, 3] /= unit_mm
        frames.append({"file_path": f"images/frame_{index}.png", "transform_matrix": opengl.tolist()})
    intrinsics = {"w": W, "h": H, "fl_x": 40.0, "fl_y": 41.0, "cx": 32.0, "cy": 24.0}
    content = {**intrinsics, **top, "frames": frames[::-1]}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def test_nerfstudio_transforms_become_opencv_poses_in_millimetres(tmp_path):
    poses = truth_poses(12)
    sequence = open_sequence(write_transforms(tmp_path, poses, camera_model="OPENCV", k1=-0.1, p1=1e-3))
    assert sequence.format == "transforms"
    assert sequence.camera == Pinhole(W, H, 40.0, 41.0, 31.5, 23.5, k1=-0.1, p1=1e-3)
    assert [path.stem for path in sequence.color_files] == [f"frame_{index}" for index in range(12)]
    np.testing.assert_allclose(sequence.T_world_camera, poses, atol=1e-9)
    np.testing.assert_allclose(sequence.depth_mm(3), 28, rtol=1e-6)
    np.testing.assert_array_equal(sequence.color(11), photo(11))


def test_transforms_in_millimetres_scale_positions_and_depth_alike(tmp_path):
    poses = truth_poses(2)
    folder = write_transforms(tmp_path, poses, unit_mm=1.0, unit="mm", depth_unit_scale_factor=0.5)
    sequence = open_sequence(folder)
    np.testing.assert_allclose(sequence.T_world_camera, poses, atol=1e-9)
    np.testing.assert_allclose(sequence.depth_mm(0), 12.5)


def test_the_scale_that_nerfstudio_applied_to_positions_is_taken_back(tmp_path):
    poses = truth_poses(3)
    sequence = open_sequence(write_transforms(tmp_path, poses, unit_mm=4000.0, applied_scale=0.25))
    np.testing.assert_allclose(sequence.T_world_camera, poses, atol=1e-9)
    np.testing.assert_allclose(sequence.depth_mm(1), 26, rtol=1e-6)
    write_poses(tmp_path / "again.json", sequence)
    np.testing.assert_allclose(read_poses(tmp_path / "again.json")[0], poses, atol=1e-9)


@pytest.mark.parametrize(
    ("lists", "training", "heldout"),
    [
        ({"train_filenames": [0, 1, 2], "test_filenames": [4]}, (0, 1, 2), (4,)),
        ({"train_filenames": [0, 1], "val_filenames": [3], "test_filenames": []}, (0, 1), (3,)),
        ({"train_filenames": [1, 2]}, (1, 2), (0, 3, 4)),
        ({"test_filenames": [2], "val_filenames": [0]}, (1, 3, 4), (2,)),
    ],
)
def test_a_split_that_a_transforms_file_lists_is_the_twins(tmp_path, lists, training, heldout):
    named = {key: [f"./images/frame_{index}.png" for index in found] for key, found in lists.items()}
    sequence = open_sequence(write_transforms(tmp_path, truth_poses(5), **named))
    assert sequence.split == Split(training, heldout)
    source = Source(str(tmp_path), "transforms", split=sequence.split)
    assert source.training(5) == list(training) and source.heldout(5) == list(heldout)
    assert Source.from_dict(json.loads(json.dumps(asdict(source)))) == source


@pytest.mark.parametrize(
    ("lists", "told"),
    [
        ({"train_filenames": ["images/frame_9.png"]}, "names images/frame_9.png, which is no frame"),
        ({"train_filenames": "images/frame_0.png"}, "no list of file names"),
        (
            {"train_filenames": ["images/frame_0.png"], "test_filenames": ["images/frame_0.png"]},
            "to be fitted and held out",
        ),
    ],
)
def test_a_split_that_makes_no_sense_is_refused(tmp_path, lists, told):
    with pytest.raises(SequenceError, match=told):
        open_sequence(write_transforms(tmp_path, truth_poses(2), **lists))


def test_training_and_test_files_are_one_sequence_with_that_split(tmp_path):
    poses = truth_poses(12)
    folder = write_transforms(tmp_path, poses)
    content = json.loads((folder / "transforms.json").read_text())
    (folder / "transforms.json").unlink()
    frames = sorted(content["frames"], key=lambda frame: int(re.sub(r"\D", "", frame["file_path"])))
    for name, chosen in (("train", [1, 2, 3, 5, 6, 7, 9, 10, 11]), ("test", [0, 4, 8])):
        part = [{**frames[i], "file_path": frames[i]["file_path"].removesuffix(".png")} for i in chosen]
        (folder / f"transforms_{name}.json").write_text(json.dumps({**content, "frames": part}))
    sequence = open_sequence(folder)
    assert sequence.split == Split((1, 2, 3, 5, 6, 7, 9, 10, 11), (0, 4, 8))
    np.testing.assert_allclose(sequence.T_world_camera, poses, atol=1e-9)
    np.testing.assert_allclose(sequence.depth_mm(8), 33, rtol=1e-6)
    write_poses(folder / "moved.json", replace(sequence, T_world_camera=poses @ np.diag([-1.0, -1, 1, 1])))
    moved = open_sequence(folder / "moved.json")
    assert moved.split == sequence.split
    np.testing.assert_allclose(moved.T_world_camera, poses @ np.diag([-1.0, -1, 1, 1]), atol=1e-9)
    (folder / "transforms_test.json").write_text(json.dumps({**content, "fl_x": 50.0, "frames": frames[:1]}))
    with pytest.raises(CameraError, match="another camera"):
        open_sequence(folder)
    (folder / "transforms_test.json").write_text(json.dumps({**content, "frames": frames[1:2]}))
    with pytest.raises(SequenceError, match=r"frame_1.png is in transforms_train.json and transforms_test"):
        open_sequence(folder)


def test_openexr_depth_of_a_transforms_file_is_in_its_unit_unless_it_says_a_scale(tmp_path):
    depth = np.random.default_rng(0).uniform(0.01, 0.08, (H, W)).astype(np.float32)
    for scale, factor in ((None, 1000.0), (0.5, 500.0)):
        top = {} if scale is None else {"depth_unit_scale_factor": scale}
        folder = write_transforms(tmp_path / str(scale), truth_poses(1), **top)
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        (folder / "depth" / "frame_0.png").unlink()
        OpenEXR.File(header, {"V": depth}).write(str(folder / "depth" / "frame_0.exr"))
        np.testing.assert_allclose(open_sequence(folder).depth_mm(0), depth * factor, rtol=1e-6)


def test_transforms_of_a_fisheye_and_depth_beside_the_photo(tmp_path):
    folder = write_transforms(
        tmp_path,
        truth_poses(2),
        camera_model="OPENCV_FISHEYE",
        k1=0.1,
        k4=-0.01,
        depth_name="images/{}_depth.png",
    )
    sequence = open_sequence(folder / "transforms.json")
    assert sequence.camera == Fisheye(W, H, 40.0, 41.0, 31.5, 23.5, k1=0.1, k4=-0.01)
    np.testing.assert_allclose(sequence.depth_mm(1), 26, rtol=1e-6)


def test_instant_ngps_field_of_view_gives_the_focal_length(tmp_path):
    folder = write_transforms(tmp_path, truth_poses(1), camera_angle_x=np.pi / 2)
    content = json.loads((folder / "transforms.json").read_text())
    for key in ("w", "h", "fl_x", "fl_y", "cx", "cy"):
        del content[key]
    content["frames"][0]["file_path"] = "images/frame_0"
    (folder / "transforms.json").write_text(json.dumps(content))
    camera = open_sequence(folder).camera
    assert camera.to_dict() == pytest.approx(Pinhole(W, H, W / 2, W / 2, 31.5, 23.5).to_dict())


def test_named_floating_point_depth_is_read(tmp_path):
    folder = write_transforms(tmp_path, truth_poses(1), depth_unit_scale_factor=1.0)
    depth_m = np.random.default_rng(0).uniform(0.01, 0.1, (H, W)).astype(np.float32)
    depth_m[0, 0] = 0
    np.save(folder / "far.npy", depth_m)
    content = json.loads((folder / "transforms.json").read_text())
    content["frames"][0]["depth_file_path"] = "far.npy"
    (folder / "transforms.json").write_text(json.dumps(content))
    depth_mm = open_sequence(folder).depth_mm(0)
    assert np.isnan(depth_mm[0, 0])
    np.testing.assert_allclose(depth_mm[1:], depth_m[1:] * 1000, rtol=1e-6)


@pytest.mark.parametrize(
    ("top", "told"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "OPENCV_FISHEYE"),
        ({"fl_x": -1}, "'fx'"),
        ({"k4": 0.1}, "'k4'"),
        ({"cx": "middle"}, "'cx'"),
        ({"fl_x": None}, "neither 'fl_x' nor 'camera_angle_x'"),
        ({"fl_x": None, "camera_angle_x": 0}, "field of view of 0 radians"),
        ({"fl_x": None, "camera_angle_x": 3.2}, "field of view of 3.2 radians"),
        ({"camera_model": "OPENCV", "is_fisheye": True}, "'is_fisheye' and 'OPENCV'"),
    ],
)
def test_a_transforms_camera_that_cannot_be_used_is_refused(tmp_path, top, told):
    with pytest.raises(CameraError, match=re.escape(told)):
        open_sequence(write_transforms(tmp_path, truth_poses(1), **top))


@pytest.mark.parametrize(
    ("top", "told"),
    [
        ({"unit": "inch"}, "'inch'"),
        ({"applied_scale": "2"}, "'applied_scale'"),
        ({"depth_unit_scale_factor": 0}, "'depth_unit_scale_factor'"),
    ],
)
def test_a_transforms_unit_that_makes_no_sense_is_refused(tmp_path, top, told):
    with pytest.raises(SequenceError, match=told):
        open_sequence(write_transforms(tmp_path, truth_poses(1), **top))


def test_a_transforms_file_with_two_cameras_is_refused(tmp_path):
    folder = write_transforms(tmp_path, truth_poses(2))
    content = json.loads((folder / "transforms.json").read_text())
    content["frames"][0]["fl_x"] = 50.0
    (folder / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(CameraError, match="different cameras"):
        open_sequence(folder)


# --- SimCol3D


def write_simcol(scene, poses, cam=None):
    """Unity's layout: y up, left-handed, centimetres; depth as value/256/255 of 20 cm."""
    folder = scene / "Frames_S1"
    for index in range(len(poses)):
        png(folder / f"FrameBuffer_{index:04d}.png", photo(index, (475, 475)))
        raw = np.full((475, 475), 256 * 51, np.uint16)
        raw[0, :2] = (0, 256 * 255)
        png(folder / f"Depth_{index:04d}.png", raw)
    mirror = np.diag([1, -1, 1])
    unity = [mirror @ pose[:3, :3] @ mirror for pose in poses]
    np.savetxt(scene / "SavedRotationQuaternion_S1.txt", Rotation.from_matrix(unity).as_quat())
    np.savetxt(scene / "SavedPosition_S1.txt", poses[:, :3, 3] @ mirror / 10)
    if cam is not None:
        (scene / "cam.txt").write_text(" ".join(map(str, cam)))
    return folder


def test_simcol_depth_poses_and_published_intrinsics(tmp_path):
    poses = truth_poses(3)
    sequence = open_sequence(write_simcol(tmp_path, poses))
    assert sequence.format == "simcol"
    assert sequence.camera == Pinhole(475, 475, 227.60416, 227.60416, 237.0, 237.0)
    np.testing.assert_allclose(sequence.T_world_camera, poses, atol=1e-9)
    depth_mm = sequence.depth_mm(1)
    assert np.isnan(depth_mm[0, :2]).all()
    np.testing.assert_allclose(depth_mm[1:], 40, rtol=1e-6)  # 51/255 of 20 cm
    np.testing.assert_array_equal(sequence.color(2), photo(2, (475, 475)))


def test_simcol_poses_turn_unitys_up_into_opencvs_down(tmp_path):
    """A Unity camera 3 cm up, turned 90° about y, looks along +x; in OpenCV's world it is at y = −30 mm."""
    folder = write_simcol(tmp_path, truth_poses(1))
    np.savetxt(tmp_path / "SavedPosition_S1.txt", [[1, 3, 2]])
    np.savetxt(tmp_path / "SavedRotationQuaternion_S1.txt", [[0, np.sqrt(0.5), 0, np.sqrt(0.5)]])
    pose = open_sequence(folder).T_world_camera[0]
    np.testing.assert_allclose(pose[:3, 3], [10, -30, 20])
    np.testing.assert_allclose(pose[:3, 2], [1, 0, 0], atol=1e-12)  # forward
    np.testing.assert_allclose(pose[:3, 1], [0, 1, 0], atol=1e-12)  # down


def test_simcols_cam_txt_overrides_the_published_intrinsics(tmp_path):
    folder = write_simcol(tmp_path, truth_poses(1), cam=[230, 0, 236, 0, 231, 238, 0, 0, 1])
    assert open_sequence(folder).camera == Pinhole(475, 475, 230.0, 231.0, 235.5, 237.5)
    (tmp_path / "cam.txt").write_text("230 0 236")
    with pytest.raises(CameraError, match=r"cam\.txt"):
        open_sequence(folder)


def test_simcol_without_its_pose_files_says_which(tmp_path):
    folder = write_simcol(tmp_path, truth_poses(1))
    (tmp_path / "SavedPosition_S1.txt").unlink()
    with pytest.raises(SequenceError, match=r"SavedPosition_S1\.txt"):
        open_sequence(folder)


# --- TUM


def write_tum(folder, poses, camera=CAMERA):
    """Photos at 30 Hz from 1 s, depth 8 ms and poses 3 ms later; depth 5000 a metre, positions in metres."""
    times = 1 + np.arange(len(poses)) / 30
    for index, time in enumerate(times):
        png(folder / "rgb" / f"{time:.6f}.png", photo(index))
        png(folder / "depth" / f"{time + 0.008:.6f}.png", np.full((H, W), 100 + 5 * index, np.uint16))
    (folder / "rgb.txt").write_text("# color\n" + "".join(f"{t:.6f} rgb/{t:.6f}.png\n" for t in times))
    depth_rows = "".join(f"{t + 0.008:.6f} depth/{t + 0.008:.6f}.png\n" for t in times)
    (folder / "depth.txt").write_text("# depth\n" + depth_rows)
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    rows = np.c_[times + 0.003, poses[:, :3, 3] / 1000, quaternions]
    np.savetxt(folder / "groundtruth.txt", rows, fmt="%.15g", header="timestamp tx ty tz qx qy qz qw")
    if camera:
        (folder / "camera.json").write_text(json.dumps(camera))
    return folder


def test_tum_pairs_photos_depth_and_poses_by_time(tmp_path):
    poses = truth_poses(5)
    sequence = open_sequence(write_tum(tmp_path, poses))
    assert (sequence.format, len(sequence)) == ("tum", 5)
    np.testing.assert_allclose(sequence.T_world_camera, poses, atol=1e-9)
    np.testing.assert_allclose(sequence.timestamps_s, 1 + np.arange(5) / 30, atol=1e-6)
    np.testing.assert_allclose(sequence.depth_mm(3), 115 / 5, rtol=1e-6)
    np.testing.assert_array_equal(sequence.color(4), photo(4))


def test_tum_leaves_out_a_photo_whose_pose_is_too_far_in_time_and_says_how_many(tmp_path, caplog):
    folder = write_tum(tmp_path, truth_poses(4))
    lines = (folder / "groundtruth.txt").read_text().splitlines()
    (folder / "groundtruth.txt").write_text("\n".join(lines[:2] + lines[3:]))  # without the second pose
    sequence = open_sequence(folder)
    np.testing.assert_allclose(sequence.T_world_camera, truth_poses(4)[[0, 2, 3]], atol=1e-9)
    np.testing.assert_allclose(sequence.depth_mm(1), 110 / 5, rtol=1e-6)
    assert "1 of the 4 photos" in caplog.text


def test_tum_needs_intrinsics_and_takes_them_from_calibration_txt(tmp_path):
    folder = write_tum(tmp_path, truth_poses(2), camera=None)
    with pytest.raises(CameraError, match=r"add a camera\.json"):
        open_sequence(folder)
    (folder / "calibration.txt").write_text("40 41 31.5 23.5\n")
    assert open_sequence(folder).camera == Pinhole(W, H, 40.0, 41.0, 31.5, 23.5)


# --- trajectories


def test_the_same_trajectory_is_read_from_all_three_kinds_of_pose_file(tmp_path):
    poses = truth_poses(3)
    c3vd, _ = read_poses(write_c3vd(tmp_path / "c3vd") / "pose.txt")
    tum, times_s = read_poses(write_tum(tmp_path / "tum", poses) / "groundtruth.txt")
    transforms, _ = read_poses(write_transforms(tmp_path, poses) / "transforms.json")
    for found in (c3vd, tum, transforms):
        np.testing.assert_allclose(found, poses, atol=1e-8)
    np.testing.assert_allclose(times_s, 1.003 + np.arange(3) / 30, atol=1e-6)


def test_written_poses_read_back_to_a_few_ulps(tmp_path):
    write_c3vd_poses(tmp_path / "pose.txt", truth_poses(4))
    np.testing.assert_allclose(read_poses(tmp_path / "pose.txt")[0], truth_poses(4), rtol=0, atol=1e-14)


def test_rotations_with_float_noise_become_exactly_orthonormal(tmp_path):
    noisy = truth_poses(2)
    noisy[:, :3, :3] += np.random.default_rng(0).uniform(-2e-4, 2e-4, (2, 3, 3))
    write_c3vd_poses(tmp_path / "pose.txt", noisy)
    rotation = read_poses(tmp_path / "pose.txt")[0][:, :3, :3]
    np.testing.assert_allclose(
        rotation.transpose(0, 2, 1) @ rotation, np.tile(np.eye(3), (2, 1, 1)), atol=1e-14
    )
    np.testing.assert_allclose(rotation, truth_poses(2)[:, :3, :3], atol=5e-4)


@pytest.mark.parametrize("content", ["", "# nothing\n", "1 2 3\n", "{}", '{"frames": [{}]}'])
def test_a_file_that_is_no_trajectory_is_refused_by_name(tmp_path, content):
    (tmp_path / "path.txt").write_text(content)
    with pytest.raises(TrajectoryError, match=r"path\.txt"):
        read_poses(tmp_path / "path.txt")


# --- bad input


def refused(folder, *told, **options):
    """Opening the sequence and reading all of it fails with one sentence that has all of ``told``."""
    with pytest.raises((SequenceError, CameraError)) as caught:
        sequence = open_sequence(folder, **options)
        for index in range(len(sequence)):
            sequence.frame(index)
    for part in told:
        assert part in str(caught.value)
    assert "\n" not in str(caught.value)


def edit_pose(folder, line, change):
    rows = np.loadtxt(folder / "pose.txt", delimiter=",")
    rows[line - 1] = change(rows[line - 1].reshape(4, 4).T).T.ravel()
    np.savetxt(folder / "pose.txt", rows, delimiter=",")


def test_no_such_folder(tmp_path):
    refused(tmp_path / "nowhere", "no folder", "nowhere")


def test_no_frames(tmp_path):
    refused(tmp_path, "no frames")
    (tmp_path / "pose.txt").write_text("")
    refused(tmp_path, "no frames")


def test_an_unknown_layout_lists_the_known_ones(tmp_path):
    (tmp_path / "holiday.txt").write_text("")
    refused(tmp_path, *FORMATS)


def test_an_unknown_format_lists_the_known_ones(tmp_path):
    with pytest.raises(OptionError, match="c3vd, transforms, simcol, tum"):
        open_sequence(tmp_path, format="kitti")


def test_a_file_in_place_of_a_folder(tmp_path):
    refused(write_c3vd(tmp_path / "c3vd") / "pose.txt", "is a file", format="c3vd")


def test_frames_and_poses_of_different_count(tmp_path):
    folder = write_c3vd(tmp_path / "c3vd")
    lines = (folder / "pose.txt").read_text().splitlines()
    (folder / "pose.txt").write_text("\n".join(lines[:2]))
    refused(folder, "3 frames but 2 poses")


def test_no_poses(tmp_path):
    folder = write_c3vd(tmp_path / "c3vd")
    (folder / "pose.txt").unlink()
    refused(folder, "pose.txt")


def test_a_photo_without_depth(tmp_path):
    folder = write_c3vd(tmp_path / "c3vd")
    (folder / "0001_depth.tiff").unlink()
    refused(folder, "0001_color.png", "no depth map")


def test_a_pose_that_is_not_rigid(tmp_path):
    folder = write_c3vd(tmp_path / "c3vd")
    edit_pose(folder, 2, lambda pose: pose @ np.diag([1.01, 1, 1, 1]))
    refused(folder, "pose.txt, line 2", "not rigid")


def test_a_mirrored_pose_is_called_left_handed(tmp_path):
    folder = write_c3vd(tmp_path / "c3vd")
    edit_pose(folder, 3, lambda pose: pose @ np.diag([1, -1, 1, 1]))
    refused(folder, "pose.txt, line 3", "not rigid", "left-handed (determinant −1)")


def test_a_transposed_pose_says_that_its_transpose_would_be_rigid(tmp_path):
    folder = write_c3vd(tmp_path / "c3vd")
    edit_pose(folder, 1, np.transpose)
    refused(folder, "pose.txt, line 1", "not rigid", "transpose would be")


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_pose_that_is_not_finite(tmp_path, value):
    folder = write_c3vd(tmp_path / "c3vd")
    edit_pose(folder, 2, lambda pose: np.where(pose == pose[0, 3], value, pose))
    refused(folder, "pose.txt, line 2", "NaN or infinity")


def test_an_unreadable_pose_line_shows_what_a_valid_one_is(tmp_path):
    folder = write_c3vd(tmp_path / "c3vd")
    lines = (folder / "pose.txt").read_text().splitlines()
    (folder / "pose.txt").write_text("\n".join([lines[0], "1,2,three", lines[2]]))
    refused(folder, "pose.txt, line 2", "16 comma-separated numbers")


def test_depth_and_colour_of_different_size(tmp_path):
    folder = write_c3vd(tmp_path / "c3vd")
    tifffile.imwrite(folder / "0002_depth.tiff", np.ones((24, 32), np.uint16))
    refused(folder, "0002_depth.tiff is 32×24", "0002_color.png is 64×48")


def test_images_of_another_size_than_the_camera(tmp_path):
    folder = write_c3vd(tmp_path / "c3vd", camera={**CAMERA, "width": 128, "height": 96})
    refused(folder, "0000_color.png is 64×48", "128×96", "camera.json")
    told = "frame_0.png is 64×48", "128×96", "of these images to transforms.json"
    refused(write_transforms(tmp_path / "transforms", truth_poses(2), w=2 * W, h=2 * H), *told)


def test_one_photo_of_another_size_than_the_others(tmp_path):
    folder = write_c3vd(tmp_path / "c3vd")
    png(folder / "0002_color.png", photo(2, (24, 32)))
    refused(folder, "0002_color.png is 32×24", "the photos before it are 64×48")


def test_a_frame_that_lacks_photo_and_depth_is_named(tmp_path):
    folder = write_c3vd(tmp_path / "c3vd", count=4)
    for name in ("0002_color.png", "0002_depth.tiff"):
        (folder / name).unlink()
    refused(folder, "3 frames but 4 poses", "number 2")


def test_a_json_file_that_is_no_transforms_file(tmp_path):
    refused(
        write_c3vd(tmp_path / "c3vd") / "camera.json", "camera.json has no list 'frames'", "name the folder"
    )


def test_the_folder_above_a_sequence_names_the_sequence(tmp_path):
    refused(write_simcol(tmp_path / "scene", truth_poses(2)).parent, "name ", "Frames_S1")


@pytest.mark.parametrize(
    ("format", "file"),
    [("simcol", "FrameBuffer_0000.png"), ("tum", "rgb.txt"), ("transforms", "transforms.json")],
)
def test_a_forced_layout_that_is_not_there_names_the_file_that_it_lacks(tmp_path, format, file):
    refused(write_c3vd(tmp_path / "c3vd"), file, format=format)


def test_photos_are_not_enlarged(tmp_path):
    folder = write_c3vd(tmp_path / "c3vd")
    with pytest.raises(OptionError, match="choose 1 or less"):
        open_sequence(folder, scale=20)


def test_depth_that_is_not_16_bit(tmp_path):
    folder = write_c3vd(tmp_path / "c3vd")
    tifffile.imwrite(folder / "0000_depth.tiff", np.ones((H, W), np.uint8))
    refused(folder, "0000_depth.tiff", "16 bit")


def test_a_byte_order_mark_is_no_part_of_a_file(tmp_path):
    folder = write_c3vd(tmp_path / "c3vd")
    before = open_sequence(folder)
    for name in ("pose.txt", "camera.json"):
        (folder / name).write_bytes(codecs.BOM_UTF8 + (folder / name).read_bytes())
    after = open_sequence(folder)
    np.testing.assert_array_equal(after.T_world_camera, before.T_world_camera)
    assert after.camera == before.camera


def test_photos_that_are_marked_as_turned_are_read_as_stored_with_a_warning(tmp_path, caplog):
    folder = write_c3vd(tmp_path / "c3vd")
    stored = open_sequence(folder).color(0)
    assert "turned" not in caplog.text
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(stored).save(folder / "0000_color.png", exif=exif)
    np.testing.assert_array_equal(open_sequence(folder).color(0), stored)
    assert "0000_color.png is marked as turned (EXIF orientation 6)" in caplog.text


@pytest.mark.parametrize("kept", [0, 10, 0.5, 0.9, -20, -5, -1])
@pytest.mark.parametrize("kind", ["color.png", "depth.tiff"])
def test_a_truncated_image_is_refused_by_name_and_nothing_is_printed(tmp_path, capfd, kind, kept):
    file = write_c3vd(tmp_path / "c3vd") / f"0001_{kind}"
    content = file.read_bytes()
    count = int(kept * len(content)) if isinstance(kept, float) else kept
    file.write_bytes(content[:count] if count else b"")
    refused(file.parent, file.name, "truncated")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("kind", ["color.png", "depth.tiff"])
def test_an_image_damaged_in_the_middle_is_refused_by_name_and_nothing_is_printed(tmp_path, capfd, kind):
    file = write_c3vd(tmp_path / "c3vd") / f"0001_{kind}"
    content = bytearray(file.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 40] = bytes(40)
    file.write_bytes(content)
    refused(file.parent, file.name, "truncated")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("compression", ["cv2", "tiff_lzw"])
def test_a_tiff_that_lost_its_end_prints_nothing_but_the_error(tmp_path, compression):
    """In a process of its own, because pytest holds on to what is logged."""
    folder = write_c3vd(tmp_path / "c3vd")
    raw = np.random.default_rng(0).integers(1, 65535, (H, W)).astype(np.uint16)
    file = folder / "0000_depth.tiff"
    if compression == "cv2":
        file.write_bytes(cv2.imencode(".tiff", raw)[1].tobytes())
    else:
        Image.fromarray(raw).save(file, compression=compression)
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2])
    code = (
        "import sys; from endotwin.sequence.readers import open_sequence\n"
        "try: open_sequence(sys.argv[1]).depth_mm(0)\n"
        "except Exception as error: print(error)"
    )
    ran = subprocess.run(
        [sys.executable, "-c", code, str(folder)], capture_output=True, text=True, check=True
    )
    assert "0000_depth.tiff is truncated" in ran.stdout
    assert ran.stderr == ""


def png_that_claims(size: int) -> bytes:
    """A PNG file of a few bytes whose header says that it is ``size`` pixels wide and high."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        body = kind + content
        return struct.pack(">I", len(content)) + body + struct.pack(">I", zlib.crc32(body))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", size, size, 8, 2, 0, 0, 0))
    return PNG_SIGNATURE + header + chunk(b"IDAT", zlib.compress(b"0")) + chunk(b"IEND", b"")


def test_a_photo_that_claims_to_be_huge_is_refused(tmp_path):
    folder = write_c3vd(tmp_path / "c3vd")
    (folder / "0000_color.png").write_bytes(png_that_claims(60_000))
    with pytest.raises(SequenceError, match=r"0000_color\.png says that it is larger than any image"):
        open_sequence(folder)


@pytest.mark.parametrize("scale", (0.01, 0.1))
def test_a_scale_that_leaves_too_few_pixels_is_refused(tmp_path, scale):
    with pytest.raises(OptionError, match=r"A scale of .* leaves .* pixels|leaves nothing"):
        open_sequence(write_c3vd(tmp_path / "c3vd"), scale=scale)


def test_a_truncated_jpeg_is_refused(tmp_path):
    folder = write_transforms(tmp_path, truth_poses(1))
    (folder / "images" / "frame_0.png").unlink()
    Image.fromarray(photo(0)).save(folder / "images" / "frame_0.jpg")
    content = (folder / "images" / "frame_0.jpg").read_bytes()
    (folder / "images" / "frame_0.jpg").write_bytes(content[: len(content) // 2])
    frames = (folder / "transforms.json").read_text().replace("frame_0.png", "frame_0.jpg")
    (folder / "transforms.json").write_text(frames)
    refused(folder, "frame_0.jpg", "truncated")


def test_an_unknown_camera_model(tmp_path):
    refused(
        write_c3vd(tmp_path / "c3vd", camera={**CAMERA, "model": "kannala"}),
        "camera.json",
        "pinhole, fisheye, omni",
    )


def test_a_sequence_is_the_same_under_any_name_of_its_folder(tmp_path):
    moved = tmp_path / "a colon, élargi"
    shutil.copytree(write_c3vd(tmp_path / "c3vd"), moved)
    np.testing.assert_array_equal(open_sequence(moved).color(0), photo(0))

"""Every layout is read back: by endotwin where it can, and by the field's own readers."""

import json
import tarfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import scenes
import tube_twin

from endotwin.cameras import CALIBRATIONS, Camera, Fisheye
from endotwin.errors import OptionError
from endotwin.render import Renderer
from endotwin.sequence.readers import open_sequence
from endotwin.synth import LAYOUTS, Trajectory, synthesize
from endotwin.synth.layouts import webdataset as tars

FRAMES = 3
STEP_MM = {"c3vd": 100 / 65535, "c3vd2": 100 / 65535, "transforms": 0.002, "tum": 0.2, "simcol": 200 / 65280}
READ_BACK = [name for name, layout in LAYOUTS.items() if layout.reads]
FISHEYE = Fisheye(96, 72, 40.0, 41.0, 47.0, 35.0, 0.02, -0.01, 0.001, 0.0)
BENT = replace(tube_twin.CAMERA, k1=-0.1, k2=0.02, p1=1e-3, p2=-1e-3)


@pytest.fixture(scope="module")
def twin():
    return tube_twin.fitted(tube_twin.seen(tube_twin.surface()))


@pytest.fixture(scope="module")
def trajectory():
    poses = np.stack([tube_twin.pose(s) for s in (0.2, 0.3, 0.45)])
    poses[:, :3, 3] += np.random.default_rng(0).uniform(-3, 3, (FRAMES, 3))
    return Trajectory(poses, np.array([0.0, 0.1, 0.4]), "three poses")


def read_back(folder: Path, layout: str):
    return open_sequence(folder / LAYOUTS[layout].root)


@pytest.mark.parametrize("layout", READ_BACK)
def test_endotwin_reads_back_poses_camera_depth_and_colour(twin, trajectory, tmp_path, layout):
    synthesize(twin, trajectory, tmp_path / "d", layout=layout)
    sequence, renderer = read_back(tmp_path / "d", layout), Renderer(twin)
    assert len(sequence) == FRAMES
    np.testing.assert_allclose(sequence.T_world_camera, trajectory.T_world_camera, atol=1e-9)
    for index in range(FRAMES):
        frame, view = sequence.frame(index), renderer.view(trajectory.T_world_camera[index])
        assert np.nanmax(np.abs(frame.depth_mm - view.depth_mm)) <= 0.51 * STEP_MM[layout]
        assert np.mean(np.isnan(frame.depth_mm) == np.isnan(view.depth_mm)) > 0.999
        assert np.abs(frame.color / 255.0 - view.color).max() <= 0.51 / 255
    np.testing.assert_allclose(
        sequence.camera.pixel_directions, twin.camera.pixel_directions, atol=1e-6, equal_nan=True
    )


@pytest.mark.parametrize(
    ("layout", "camera"),
    [
        *((layout, CALIBRATIONS["c3vd-v1"].scaled(0.07)) for layout in READ_BACK if layout != "transforms"),
        *((layout, camera) for layout in ("transforms", "tum", "simcol") for camera in (FISHEYE, BENT)),
    ],
    ids=lambda value: value.model if isinstance(value, Camera) else value,
)
def test_another_lens_reads_back_as_it_was_given(twin, trajectory, tmp_path, layout, camera):
    synthesize(twin, trajectory, tmp_path / "d", layout=layout, camera=camera)
    sequence = read_back(tmp_path / "d", layout)
    np.testing.assert_allclose(
        sequence.camera.pixel_directions, camera.pixel_directions, atol=1e-5, equal_nan=True
    )
    view = Renderer(twin, camera).view(trajectory.T_world_camera[0])
    depth_mm = sequence.depth_mm(0)
    there = view.depth_mm > 1
    assert np.nanmax(np.abs(depth_mm - view.depth_mm)[there]) <= 0.51 * STEP_MM[layout]


@pytest.mark.parametrize("camera", [None, FISHEYE], ids=["pinhole", "fisheye"])
def test_instant_ngp_finds_depth_and_lens_under_its_own_names(twin, trajectory, tmp_path, camera):
    synthesize(twin, trajectory, tmp_path / "d", layout="transforms", camera=camera)
    content = json.loads((tmp_path / "d" / "transforms.json").read_text())
    assert content["is_fisheye"] is (camera is not None)
    frame = content["frames"][1]
    assert (
        frame["depth_path"] == frame["depth_file_path"] and (tmp_path / "d" / frame["depth_path"]).is_file()
    )


def test_a_lens_beyond_180_degrees_sees_as_far_as_its_own_rays(twin, trajectory, tmp_path):
    """The same poses through C3VD's lens: its depth is the tube's, as the pinhole's is."""
    camera = scenes.omni()
    synthesize(twin, trajectory, tmp_path / "d", camera=camera)
    sequence = read_back(tmp_path / "d", "c3vd")
    frame = sequence.frame(1)
    rays = camera.pixel_directions
    there = np.isfinite(frame.depth_mm) & (rays[..., 2] > 0.1)
    points = rays[there] * (frame.depth_mm[there] / rays[there][:, 2])[:, None]
    world = points @ frame.T_world_camera[:3, :3].T + frame.T_world_camera[:3, 3]
    radius_mm = np.linalg.norm(tube_twin.to_axis(world)[1], axis=1)
    assert there.mean() > 0.5
    np.testing.assert_allclose(radius_mm, tube_twin.RADIUS_MM, atol=0.05)


@pytest.mark.parametrize("layout", ["transforms"])
def test_a_camera_that_a_layout_cannot_describe_is_refused(twin, trajectory, tmp_path, layout):
    with pytest.raises(OptionError, match="omni camera"):
        synthesize(twin, trajectory, tmp_path / "d", layout=layout, camera=scenes.omni())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("layout", ["tum", "simcol", "flat"])
def test_a_layout_that_lists_depth_needs_it(twin, trajectory, tmp_path, layout):
    with pytest.raises(OptionError, match=r"needs depth"):
        synthesize(twin, trajectory, tmp_path / "d", layout=layout, labels=("rgb",))


def test_evo_reads_the_tum_trajectory(twin, trajectory, tmp_path):
    file_interface = pytest.importorskip("evo.tools.file_interface")
    synthesize(twin, trajectory, tmp_path / "d", layout="tum")
    read = file_interface.read_tum_trajectory_file(tmp_path / "d" / "groundtruth.txt")
    assert read.check()[0]
    np.testing.assert_allclose(read.timestamps, trajectory.timestamps_s, atol=1e-6)
    expected = trajectory.T_world_camera.copy()
    expected[:, :3, 3] /= 1000
    np.testing.assert_allclose(np.array(read.poses_se3), expected, atol=1e-12)


def test_the_flat_list_is_read_as_depth_anything_reads_it(twin, trajectory, tmp_path):
    """Its VKITTI2 loader: 'image depth' a line, depth / 100."""
    synthesize(twin, trajectory, tmp_path / "d", layout="flat")
    view = Renderer(twin).view(trajectory.T_world_camera[2])
    lines = (tmp_path / "d" / "filelist.txt").read_text().splitlines()
    assert len(lines) == FRAMES
    image_path, depth_path = lines[2].split(" ")
    image = cv2.cvtColor(cv2.imread(str(tmp_path / "d" / image_path)), cv2.COLOR_BGR2RGB) / 255.0
    depth = cv2.imread(str(tmp_path / "d" / depth_path), cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH) / 100.0
    assert np.abs(image - view.color).max() <= 0.51 / 255
    np.testing.assert_allclose(depth[view.mask], view.depth_mm[view.mask], atol=0.0051)
    assert np.all(depth[~view.mask] == 0)


def test_webdataset_reads_the_tars(twin, trajectory, tmp_path, monkeypatch):
    """Keys, images and what is known of each frame, by the library's own reader, over more than one tar."""
    reader = pytest.importorskip("webdataset")
    monkeypatch.setitem(LAYOUTS, "webdataset", replace(tars.LAYOUT, shard_frames=2))
    synthesize(twin, trajectory, tmp_path / "d", layout="webdataset", labels=("rgb", "depth", "triangles"))
    files = sorted(str(file) for file in (tmp_path / "d").glob("*.tar"))
    assert len(files) == 2
    samples = list(reader.WebDataset(files, shardshuffle=False))
    assert [sample["__key__"] for sample in samples] == ["0000", "0001", "0002"]
    for sample, T_world_camera in zip(samples, trajectory.T_world_camera, strict=True):
        record = json.loads(sample["json"])
        np.testing.assert_array_equal(record["T_world_camera"], T_world_camera)
        depth = cv2.imdecode(np.frombuffer(sample["depth.tiff"], np.uint8), cv2.IMREAD_UNCHANGED)
        view = Renderer(twin).view(T_world_camera)
        np.testing.assert_allclose(
            (depth * (100 / 65535))[view.mask], view.depth_mm[view.mask], atol=0.51 * 100 / 65535
        )
    with tarfile.open(files[0]) as tar:
        assert {member.mtime for member in tar} == {0}


def test_frames_jsonl_tells_of_every_frame_in_every_layout(twin, trajectory, tmp_path):
    for layout in LAYOUTS:
        synthesize(twin, trajectory, tmp_path / layout, layout=layout)
        lines = (tmp_path / layout / "frames.jsonl").read_text().splitlines()
        records = [json.loads(line) for line in lines]
        assert [record["index"] for record in records] == [0, 1, 2]
        np.testing.assert_array_equal([r["T_world_camera"] for r in records], trajectory.T_world_camera)
        conventions = json.loads((tmp_path / layout / "dataset.json").read_text())["conventions"]
        assert {"rgb", "depth", "normals", "mask", "frames"} <= set(conventions)


def test_a_layout_that_does_not_exist_is_refused_with_those_that_do(twin, trajectory, tmp_path):
    with pytest.raises(OptionError, match="webdataset"):
        synthesize(twin, trajectory, tmp_path / "d", layout="betamax")

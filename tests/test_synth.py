"""Rendered datasets: what is written is what was rendered, reads back, repeats its bytes, and is whole."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import tifffile
import tube_twin

from endotwin.errors import OutputError, TwinError
from endotwin.render import Renderer
from endotwin.sequence.readers import open_sequence
from endotwin.synth import (
    DEFAULT_LABELS,
    Trajectory,
    fixed,
    parse_light_edit,
    parse_material_edit,
    synthesize,
)
from endotwin.synth.encodings import encode_depth
from endotwin.synth.job import fingerprint
from endotwin.synth.run.statistics import STRIDE, Statistics

QUANTUM_MM = 100 / 65535


@pytest.fixture(scope="module")
def twin():
    return tube_twin.fitted(tube_twin.seen(tube_twin.surface()))


@pytest.fixture(scope="module")
def trajectory():
    poses = np.stack([tube_twin.pose(s) for s in (0.1, 0.3, 1 / 3, 0.9)])
    poses[:, :3, 3] += np.random.default_rng(0).uniform(-3, 3, (4, 3))
    return Trajectory(poses, np.array([0.0, 0.1, 0.4, 1 / 3]), "four poses")


@pytest.fixture(scope="module")
def written(twin, trajectory, tmp_path_factory):
    folder = tmp_path_factory.mktemp("synth") / "dataset"
    summary = synthesize(twin, trajectory, folder, seed=5)
    return folder, summary


def test_the_dataset_reads_back_with_the_same_poses_camera_depth_and_colour(twin, trajectory, written):
    sequence = open_sequence(written[0])
    renderer = Renderer(twin)
    assert (sequence.format, len(sequence), sequence.camera) == ("c3vd", 4, twin.camera)
    np.testing.assert_allclose(sequence.T_world_camera, trajectory.T_world_camera, rtol=0, atol=1e-14)
    for index in range(4):
        frame, view = sequence.frame(index), renderer.view(trajectory.T_world_camera[index])
        np.testing.assert_array_equal(
            np.isnan(frame.depth_mm), np.isnan(view.depth_mm) | (view.depth_mm >= 99.999)
        )
        assert np.nanmax(np.abs(frame.depth_mm - view.depth_mm)) <= 0.51 * QUANTUM_MM
        assert np.abs(frame.color / 255.0 - view.color).max() <= 0.51 / 255
        assert frame.color.std() > 10


def test_pose_rows_are_exact_columns_of_the_camera_to_world_matrix(trajectory, written):
    rows = np.loadtxt(written[0] / "pose.txt", delimiter=",")
    np.testing.assert_array_equal(rows.reshape(-1, 4, 4).transpose(0, 2, 1), trajectory.T_world_camera)
    np.testing.assert_array_equal(np.loadtxt(written[0] / "timestamps.txt"), trajectory.timestamps_s)


def test_depth_and_normals_are_those_of_the_true_tube(trajectory, written):
    """Read by tifffile, against the tube's equation: both the geometry and the encoding are right."""
    v, u = np.meshgrid(np.arange(72.0), np.arange(96.0), indexing="ij")
    rays = np.stack([(u - 47.5) / 58, (v - 35.5) / 58, np.ones_like(u)], axis=-1)
    for index, T in enumerate(trajectory.T_world_camera):
        raw = tifffile.imread(written[0] / f"{index:04d}_depth.tiff")
        normals = tifffile.imread(written[0] / f"{index:04d}_normals.tiff") / 65535 * 2 - 1
        there = raw > 0
        points = (raw * QUANTUM_MM)[..., None][there] * rays[there] @ T[:3, :3].T + T[:3, 3]
        s, inward = tube_twin.to_axis(points)
        radius_mm = np.linalg.norm(inward, axis=1)
        np.testing.assert_allclose(radius_mm, tube_twin.RADIUS_MM, atol=0.02)
        expected = (inward / radius_mm[:, None]) @ T[:3, :3]
        within = (s > 0.02) & (s < tube_twin.SWEEP - 0.02)
        assert np.abs(normals[there] - expected)[within].max() < 0.01
        assert np.all(normals[~there] == -1)


def test_the_mask_tells_photographed_from_unseen_surface_and_from_none(trajectory, tmp_path):
    mesh = tube_twin.seen(tube_twin.surface())
    s = tube_twin.to_axis(mesh.vertices_mm + mesh.origin_mm)[0]
    half = mesh.with_coverage(np.where(s < 0.6, mesh.seen_by, 0).astype(np.int32), mesh.nearest_mm)
    folder = tmp_path / "dataset"
    summary = synthesize(tube_twin.fitted(half), trajectory, folder)
    v, u = np.meshgrid(np.arange(72.0), np.arange(96.0), indexing="ij")
    rays = np.stack([(u - 47.5) / 58, (v - 35.5) / 58, np.ones_like(u)], axis=-1)
    shares = []
    for index, T in enumerate(trajectory.T_world_camera):
        mask = cv2.imread(str(folder / f"{index:04d}_mask.png"), cv2.IMREAD_UNCHANGED)
        raw = tifffile.imread(folder / f"{index:04d}_depth.tiff")
        np.testing.assert_array_equal(mask == 0, raw == 0)
        s = tube_twin.to_axis((raw * QUANTUM_MM)[..., None] * rays @ T[:3, :3].T + T[:3, 3])[0]
        assert np.all(mask[(raw > 0) & (s < 0.58)] == 255)
        assert np.all(mask[(raw > 0) & (s > 0.62)] == 128)
        shares.append((mask == 255).mean())
    assert summary.valid == pytest.approx(np.mean(shares))
    assert 0.1 < summary.valid < 0.9


def test_the_same_command_gives_the_same_bytes(twin, trajectory, written, tmp_path):
    edited = fixed([parse_material_edit("roughness*1.1")])
    synthesize(twin, trajectory, tmp_path / "again", seed=5)
    synthesize(twin, trajectory, tmp_path / "edited", seed=5, variation=edited)
    names = sorted(file.name for file in written[0].iterdir())
    assert names == sorted(file.name for file in (tmp_path / "again").iterdir())
    assert len(names) == 4 * 4 + 6
    for name in names:
        assert (tmp_path / "again" / name).read_bytes() == (written[0] / name).read_bytes(), name
    assert (tmp_path / "edited" / "0000_color.png").read_bytes() != (
        written[0] / "0000_color.png"
    ).read_bytes()
    assert (tmp_path / "edited" / "0000_depth.tiff").read_bytes() == (
        written[0] / "0000_depth.tiff"
    ).read_bytes()


def test_a_quarter_of_the_intensity_gives_the_response_of_a_quarter(twin, trajectory, written, tmp_path):
    synthesize(
        twin, trajectory, tmp_path / "dim", variation=fixed(light=[parse_light_edit("intensity*0.25")])
    )
    bright = cv2.imread(str(written[0] / "0001_color.png")).astype(float)
    dim = cv2.imread(str(tmp_path / "dim" / "0001_color.png")).astype(float)
    clear = (bright > 60) & (bright < 250)
    assert clear.sum() > 1000
    assert np.median(dim[clear] / bright[clear]) == pytest.approx(0.25 ** (1 / 2.2), rel=0.01)


def test_dataset_json_tells_what_was_done_and_no_path(twin, trajectory, tmp_path):
    edits = fixed([parse_material_edit("metallic=0.1")], [parse_light_edit("n*2")])
    synthesize(twin, trajectory, tmp_path / "dataset", seed=9, variation=edits)
    text = (tmp_path / "dataset" / "dataset.json").read_text()
    document = json.loads(text)
    assert document["frames"] == 4 and document["seed"] == 9 and document["trajectory"] == "four poses"
    assert document["variation"]["material"] == ["metallic=0.1"]
    assert document["variation"]["light"] == ["n*2.0"]
    assert document["labels"] == list(DEFAULT_LABELS) and set(DEFAULT_LABELS) <= set(document["conventions"])
    assert document["twin"]["sha256"] == fingerprint(twin) and "licence" in document["license_note"]
    assert 0 < document["coverage"]["valid"] <= 1
    assert str(tmp_path) not in text
    edited, _ = edits.draw(range(1), 0)[0].edited(twin)
    assert fingerprint(edited) != fingerprint(twin)


def test_the_datasheet_is_one_page_that_needs_no_other_file(written):
    page = (written[0] / "datasheet.html").read_text()
    assert page.count("data:image/jpeg;base64,") == 4
    assert "<svg" in page and "Coverage" in page and "licence" in page
    assert "http" not in page and 'src="/' not in page


def test_depth_is_rounded_clipped_at_100_mm_and_0_where_there_is_none():
    depth_mm = np.array([[np.nan, 1e-4, 50.001, 99.9999, 250.0, -3.0, 0.0, np.inf]], np.float32)
    np.testing.assert_array_equal(encode_depth(depth_mm), [[0, 1, 32768, 65535, 65535, 0, 0, 65535]])


def test_depth_behind_the_lens_and_none_at_all_are_in_no_bin_of_the_statistics():
    depth_mm = np.array([-40.0, -1e-3, 0.0, 1.9, 3.0, 99.0, 250.0, 1e30, np.nan, np.inf, -np.inf], np.float32)
    counted = Statistics()
    counted.add({"depth": np.repeat(np.repeat(depth_mm[None], STRIDE, axis=0), STRIDE, axis=1)})
    assert counted.depth[[0, 1, -1]].tolist() == [2, 1, 3] and counted.depth.sum() == 6


def test_progress_ends_at_the_number_of_frames(twin, trajectory, tmp_path):
    calls = []
    synthesize(twin, trajectory, tmp_path / "dataset", progress=lambda *call: calls.append(call))
    assert calls[-1] == ("render", 4, 4)


def test_an_unfitted_twin_and_a_taken_name_are_refused_and_nothing_is_left(twin, trajectory, tmp_path):
    with pytest.raises(TwinError, match="fit"):
        synthesize(tube_twin.unfitted(twin), trajectory, tmp_path / "new")
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "mine").write_text("precious")
    for overwrite in (False, True):
        with pytest.raises(OutputError, match=r"no dataset\.json"):
            synthesize(twin, trajectory, tmp_path / "taken", overwrite=overwrite)
    assert sorted(file.name for file in tmp_path.rglob("*")) == ["mine", "taken"]


def test_a_dataset_is_replaced_only_where_that_is_asked_for(twin, trajectory, tmp_path):
    synthesize(twin, trajectory, tmp_path / "taken", labels=("rgb",))
    with pytest.raises(OutputError, match="--overwrite"):
        synthesize(twin, trajectory, tmp_path / "taken")
    assert not (tmp_path / "taken" / "0000_depth.tiff").exists()
    synthesize(twin, trajectory, tmp_path / "taken", overwrite=True)
    assert len(open_sequence(tmp_path / "taken")) == 4
    assert list(tmp_path.iterdir()) == [tmp_path / "taken"]


def test_a_dataset_never_replaces_the_sequence_of_its_twin(twin, trajectory, tmp_path):
    synthesize(twin, trajectory, tmp_path / "taken")
    source = replace(twin.source, path=str(tmp_path / "taken"))
    with pytest.raises(OutputError, match="is read from it"):
        synthesize(replace(twin, source=source), trajectory, tmp_path / "taken", seed=1, overwrite=True)
    assert len(open_sequence(tmp_path / "taken")) == 4


@pytest.mark.parametrize(("L0", "word"), [(1e-6, "black"), (1e6, "saturated")])
def test_a_dataset_that_shows_nothing_gives_a_warning(twin, trajectory, tmp_path, caplog, L0, word):
    synthesize(
        replace(twin, light=replace(twin.light, L0=L0)), trajectory, tmp_path / "new", labels=("rgb", "mask")
    )
    assert word in caplog.text


def test_nothing_is_written_that_was_not_asked_for(twin, trajectory, tmp_path):
    summary = synthesize(twin, trajectory, tmp_path / "depth", labels=("depth",))
    images = [file.name for file in (tmp_path / "depth").iterdir() if file.suffix in (".png", ".tiff")]
    assert sorted(images) == [f"{index:04d}_depth.tiff" for index in range(4)]
    assert summary.valid is None

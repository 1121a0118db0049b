"""``endotwin check``: planted mistakes are named, sound sequences pass, and the measures behind it are
right."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import tube_sequence
from damaged import DAMAGES, Copy
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from endotwin.cameras import CALIBRATIONS, Pinhole
from endotwin.check import KINDS, check
from endotwin.check.depths import prepared
from endotwin.check.photo import correlation, reduced_photo, rim_offset, shading_of
from endotwin.check.precise import estimate
from endotwin.check.reading import BASES, Lens, Reading, signed_permutations
from endotwin.check.stream import sharpness_of
from endotwin.check.views import read_views
from endotwin.check.warp import disagreement
from endotwin.effects.codec import Codec
from endotwin.errors import SequenceError
from endotwin.sequence import Sequence
from endotwin.sequence.readers import open_sequence

pytestmark = pytest.mark.slow

OF_POSES = ["poses transposed", "poses inverted", "poses in m", "one pose for all"]
OF_LENS = ["intrinsics of half size", "principal point + 0.5 px", "photos one frame late"]
OFFSETS = st.floats(-2, 2)


def named(folder: Path) -> set[str]:
    """Kinds of the findings of a check."""
    report = check(folder)
    assert all(finding.kind in KINDS and finding.says and finding.file for finding in report.findings)
    return {finding.kind for finding in report.findings}


def damaged(source: Path, folder: Path, name: str, noise: float = 0.0) -> Path:
    copy = Copy(source)
    DAMAGES[name].do(copy)
    return copy.write(folder, noise)


def test_a_sound_sequence_passes(example):
    report = check(example)
    assert report.consistent and not report.notes
    assert json.loads(json.dumps(report.to_dict()))["consistent"] is True


def test_what_a_recorder_did_to_the_photos_is_noted(example, tmp_path):
    folder = shutil.copytree(example, tmp_path / "coded")
    for file in folder.glob("*_color.png"):
        photo = cv2.imread(str(file))[..., ::-1].astype(np.float32) / 255
        cv2.imwrite(str(file), np.rint(255 * Codec(70).recorded(photo)).astype(np.uint8)[..., ::-1])
    report = check(folder)
    assert report.consistent and [note.partition(";")[0] for note in report.notes] == [
        "codec: the photos were coded as JPEG pictures of quality 70"
    ]


def test_photos_whose_red_and_blue_are_swapped_are_noted(example, tmp_path):
    copy = Copy(example)
    copy.every_photo(lambda photo: photo[..., ::-1])
    report = check(copy.write(tmp_path / "copy"))
    assert report.consistent and any("red and blue may be swapped" in note for note in report.notes)


@pytest.mark.parametrize("name", [*OF_POSES, *OF_LENS])
def test_a_planted_mistake_is_named(example, tmp_path, name):
    found = named(damaged(example, tmp_path / "copy", name, noise=0.005 if name in OF_POSES else 0.0))
    assert found and found <= set(DAMAGES[name].named)


def test_single_frames_are_named(example, tmp_path):
    copy = Copy(example)
    copy.colors[5] = copy.colors[4]
    copy.photo[7] = lambda photo: 0 * photo
    copy.photo[10] = lambda photo: cv2.GaussianBlur(photo, (0, 0), 2)
    copy.depths[2] = copy.depths[1]
    copy.T[15, :3, 3] += 0.3
    copy.T[[19, 20]] = copy.T[[20, 19]]
    copy.write(tmp_path / "copy")
    frames: dict[str, set[str]] = {}
    for finding in check(tmp_path / "copy").findings:
        frames.setdefault(finding.kind, set()).update(finding.frames)
    assert frames == {
        "duplicate": {"0005_color.png", "0002_color.png"},
        "blank": {"0007_color.png"},
        "blurred": {"0010_color.png"},
        "misregistered": {"0015_color.png"},
        "mistimed": {"0019_color.png", "0020_color.png"},
    }


def test_frames_of_tissue_that_moves_are_not_held_against_one_another(example, tmp_path):
    folder = damaged(example, tmp_path / "copy", "poses transposed")
    assert check(folder).findings
    (folder / "dataset.json").write_text('{"motion": {"peristalsis": {}}}')
    report = check(folder)
    assert not {"disagreement", "principal_point", "photos_offset"} & {each.kind for each in report.findings}
    assert "moves by itself" in report.notes[0]


@pytest.mark.parametrize(("width", "height"), [(16, 16), (64, 20), (40, 30)])
def test_pictures_of_a_few_pixels_are_checked_as_far_as_they_tell(tmp_path, width, height):
    report = check(tube_sequence.write(tmp_path / "tube", 6, width, height))
    assert report.consistent and report.notes


def test_half_a_pixel_is_measured_through_depth_noise(example, tmp_path):
    sequence = open_sequence(damaged(example, tmp_path / "copy", "principal point + 0.5 px", noise=0.01))
    views = read_views(sequence, sequence.T_world_camera)
    fine = estimate(views, Reading())
    assert views.noise == pytest.approx(0.01, rel=0.1)
    assert fine.step[3:5] == pytest.approx([-0.5, -0.5], abs=0.2)
    assert (np.abs(fine.step[[0, 1, 2]]) < 0.005).all() and abs(fine.step[6]) < 0.05


def transforms_of(sequence: Sequence, matrices: np.ndarray) -> dict:
    """The ``transforms.json`` of every second frame of ``sequence``, its poses ``matrices`` [N, 4, 4]."""
    camera, frames = sequence.camera, zip(sequence.color_files[::2], sequence.depth_files[::2], strict=True)
    return {
        **{"w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy, "unit": "mm"},
        **{"cx": camera.cx + 0.5, "cy": camera.cy + 0.5, "depth_unit_scale_factor": 100 / 65535},
        "frames": [
            {"file_path": str(color), "depth_file_path": str(depth), "transform_matrix": matrix.tolist()}
            for (color, depth), matrix in zip(frames, matrices, strict=True)
        ],
    }


def test_matrices_of_a_transforms_json_written_transposed_or_as_opencv_are_named(example, tmp_path):
    sequence = open_sequence(example)
    T = sequence.T_world_camera[::2]
    opengl = T @ np.diag([1.0, -1.0, -1.0, 1.0])
    for matrices, kind in (
        (opengl, None),
        (opengl.transpose(0, 2, 1), "poses_transposed"),
        (np.linalg.inv(opengl), "poses_inverted"),
        (T, "poses_opengl"),
    ):
        content = transforms_of(sequence, matrices)
        (tmp_path / "transforms.json").write_text(json.dumps(content))
        assert named(tmp_path / "transforms.json") == ({kind} if kind else set())
    pair = tmp_path / "pair"
    pair.mkdir()
    for name, chosen in (("train", content["frames"][1:]), ("test", content["frames"][:1])):
        turned = [
            {**frame, "transform_matrix": np.transpose(matrix).tolist()}
            for frame, matrix in zip(chosen, opengl[1:] if name == "train" else opengl[:1], strict=True)
        ]
        (pair / f"transforms_{name}.json").write_text(json.dumps({**content, "frames": turned}))
    (finding,) = check(pair).findings
    assert (
        finding.kind == "poses_transposed" and "transforms_train.json and transforms_test" in finding.change
    )


def test_depth_in_another_unit_is_mended_by_the_factor_in_a_transforms_json(example, tmp_path):
    sequence = open_sequence(example)
    content = transforms_of(sequence, sequence.T_world_camera[::2] @ np.diag([1.0, -1.0, -1.0, 1.0]))
    content["depth_unit_scale_factor"] /= 1000
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    (finding,) = check(tmp_path).findings
    assert finding.kind == "depth_unit" and "the depth maps" in finding.file
    assert "Multiply depth_unit_scale_factor in transforms.json by 1000" in finding.change


def test_what_no_reading_mends_keeps_the_readers_own_sentence(example, tmp_path):
    copy = Copy(example)
    copy.T[3, 0, 0] = np.nan
    with pytest.raises(SequenceError, match="line 4"):
        check(copy.write(tmp_path / "copy"))
    with pytest.raises(SequenceError, match="no folder"):
        check(tmp_path / "nowhere")


def test_depth_maps_of_another_size_are_named(example, tmp_path):
    copy = Copy(example)
    copy.every_depth(lambda depth_mm: depth_mm[::2, ::2])
    assert named(copy.write(tmp_path / "copy")) == {"depth_size"}


@pytest.mark.parametrize("camera", [Pinhole(64, 48, 40, 41, 30, 25), CALIBRATIONS["c3vd-v1"]])
def test_a_lens_of_resized_images_sees_what_the_resized_camera_sees(camera):
    uv = np.array([[3.0, 4.0], [20.5, 11.0], [25.0, 20.0]])
    lens, half = Lens.of_resized(0.5, 0.5), camera.scaled(0.5)
    np.testing.assert_allclose(camera.directions(lens.calibrated(uv)), half.directions(uv), atol=1e-9)
    np.testing.assert_allclose(lens.image(lens.calibrated(uv)), uv)


@given(OFFSETS, OFFSETS, st.floats(0.5, 2))
def test_an_adjusted_lens_is_the_camera_with_those_numbers(shift_u, shift_v, factor):
    camera = Pinhole(64, 48, 40, 41, 30, 25)
    truth = Pinhole(64, 48, 40 * factor, 41 * factor, 30 + shift_u, 25 + shift_v)
    lens = Lens().adjusted(camera, np.full(2, factor), np.array([shift_u, shift_v]))
    uv = np.array([[3.0, 4.0], [60.0, 40.0]])
    np.testing.assert_allclose(camera.directions(lens.calibrated(uv)), truth.directions(uv), atol=1e-12)


def test_readings_of_poses_are_what_their_names_say():
    T = np.tile(np.eye(4), (5, 1, 1))
    T[:, :3, :3] = Rotation.random(5, np.random.default_rng(0)).as_matrix()
    T[:, :3, 3] = np.random.default_rng(1).normal(size=(5, 3))
    frames = np.arange(4)
    inverse = Reading(base=BASES[1]).poses(T, frames)
    np.testing.assert_allclose(inverse, np.linalg.inv(T)[:4], atol=1e-12)
    np.testing.assert_array_equal(Reading(shift=1).poses(T, frames), T[1:])
    half = Reading(shift=0.5).poses(T, frames)
    from_start, to_stop = (np.linalg.inv(a) @ b for a, b in ((T[:4], half), (half, T[1:])))
    np.testing.assert_allclose(from_start[:, :3, :3], to_stop[:, :3, :3], atol=1e-12)
    assert np.isnan(Reading(shift=-1).poses(T, frames)[0]).all()
    assert np.linalg.det(signed_permutations()).sum() == 0 and len(set(signed_permutations())) == 48


@pytest.mark.parametrize("noise", [0.0, 0.005, 0.02])
def test_the_noise_of_a_slanted_plane_is_measured(noise):
    u, v = np.meshgrid(np.arange(160.0), np.arange(120.0))
    plane_mm = 1 / (0.05 - 1e-4 * u + 5e-5 * v)
    white = np.random.default_rng(0).standard_normal(plane_mm.shape)
    depth = prepared((plane_mm * (1 + noise * white)).astype(np.float32), np.ones(plane_mm.shape))
    assert depth.noise == pytest.approx(noise, rel=0.05, abs=3e-4)
    error = np.nanstd(depth.inverse * plane_mm - 1)
    assert error < 2e-3


@given(OFFSETS, OFFSETS)
def test_rims_tell_where_a_photo_lies_on_its_depth(shift_u, shift_v):
    u, v = np.meshgrid(np.arange(160.0), np.arange(120.0))
    near = np.hypot(u - 80, v - 60) < 35
    distance = np.hypot(u - 80 - shift_u, v - 60 - shift_v) - 35
    grey = 40 + 120 * np.clip(0.5 - distance, 0, 1)
    photo = np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)
    offset = rim_offset(photo, np.where(near, 20.0, 40.0).astype(np.float32), np.zeros(2))
    assert offset == pytest.approx([shift_u, shift_v], abs=0.15)


def test_shading_correlates_with_its_own_photo_only_and_blur_costs_sharpness(example):
    sequence = open_sequence(example)
    shading = shading_of(sequence, 10)
    own, other = (correlation(reduced_photo(sequence.color(k)), shading) for k in (10, 13))
    assert own > 0.6 > 0.3 > other
    grey = sequence.color(10)[..., 0]
    assert sharpness_of(cv2.GaussianBlur(grey, (0, 0), 2)) < sharpness_of(grey) - 0.5


def test_a_small_error_of_scale_costs_agreement_in_proportion(example):
    sequence = open_sequence(example)
    views = read_views(sequence, sequence.T_world_camera)
    right, near, far = (disagreement(views, Reading(scale=s)).median for s in (1.0, 1.01, 1.02))
    assert right < 1e-4 and far == pytest.approx(2 * near, rel=0.1)


@pytest.mark.parametrize(
    "sequence",
    ["colon_offset", *(pytest.param(each, marks=pytest.mark.long) for each in ("colon_gi", "colon_fisheye"))],
)
def test_larger_sound_sequences_pass(data_root, sequence):
    assert named(data_root / sequence) == set()


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "sequence"), list(zip(OF_LENS, ["colon_fisheye", "colon_gi", "colon_fisheye"], strict=True))
)
def test_mistakes_in_larger_noisy_sequences_are_named(data_root, tmp_path, name, sequence):
    found = named(damaged(data_root / sequence, tmp_path / "copy", name, noise=0.005))
    assert found and found <= set(DAMAGES[name].named)

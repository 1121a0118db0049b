"""Scores of twins whose error is known beforehand, because the photos are their own renderings."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import tube_sequence

from endotwin.effects.gain import Gain
from endotwin.errors import OptionError, OutputError, SequenceError, TwinError
from endotwin.evaluation import evaluate
from endotwin.evaluation.evaluation import MEANS
from endotwin.evaluation.renders import rendered_files
from endotwin.pipeline import fuse_twin
from endotwin.render import Renderer
from endotwin.sequence.readers import open_sequence
from endotwin.twin import Light, Materials, Registration, Response, Twin

JSON_KEYS = [*MEANS, "lpips_network", "gamma", "light", "frames"]


@pytest.fixture(scope="module")
def twin(tmp_path_factory) -> Twin:
    """A twin with known materials, and photos of its sequence that are its own renderings in 8 bit."""
    folder = tube_sequence.write(tmp_path_factory.mktemp("evaluation") / "tube", frames=10)
    twin = fuse_twin(folder)
    z = twin.surface.vertices_mm[:, 2]
    color = np.stack([0.5 + 0.2 * np.sin(z), 0.4 + 0.1 * np.cos(z), 0.3 + 0 * z], axis=1).astype(np.float32)
    materials = Materials(color, np.full(len(z), 0.6, np.float32), np.zeros(len(z), np.float32))
    twin = replace(twin, materials=materials, light=Light(40.0, 2.0, 2.0), response=Response(1 / 2.2))
    renderer, sequence = Renderer(twin), twin.source.open()
    for index in twin.source.heldout(len(sequence)):
        render = renderer.view(sequence.T_world_camera[index]).color
        cv2.imwrite(str(sequence.color_files[index]), np.uint8(render * 255 + 0.5)[..., ::-1])
    return twin


def test_a_twin_predicts_its_own_renderings_to_the_last_bit_of_the_photo(twin):
    evaluation = evaluate(twin)
    rounding_db = -10 * np.log10((1 / 255) ** 2 / 12)
    assert [frame.index for frame in evaluation.frames] == [0, 8]
    assert evaluation.psnr == pytest.approx(rounding_db, abs=1.0)
    assert evaluation.ssim > 0.998


def test_a_wrong_response_costs_what_its_closed_form_says(twin):
    darker = replace(twin, light=replace(twin.light, L0=twin.light.L0 * 0.8))
    sequence, renderer = twin.source.open(), Renderer(twin)
    frame = sequence.frame(0)
    valid = sequence.lens_mask & np.isfinite(frame.depth_mm)
    color = renderer.view(frame.T_world_camera, valid).color[valid]
    error = color * (1 - 0.8 ** (1 / 2.2))
    expected = -10 * np.log10(np.mean(error**2))
    assert color.max() < 1
    assert evaluate(darker).frames[0].psnr == pytest.approx(expected, abs=0.15)


def test_the_gain_of_a_held_out_frame_is_read_from_its_photo(twin):
    gain = Gain(frames=(1, 2), log_gain=(0.1, -0.1))
    automatic = replace(twin, effects=twin.effects.including(gain))
    brighter = replace(automatic, light=replace(twin.light, L0=twin.light.L0 * 1.25))
    frames = evaluate(brighter).frames
    assert [frame.gain for frame in frames] == pytest.approx([0.8] * 2, rel=0.005)
    assert evaluate(brighter).psnr == pytest.approx(evaluate(twin).psnr, abs=0.2)
    assert [frame.gain for frame in evaluate(twin).frames] == [1.0] * len(frames)
    assert "gain" in str(evaluate(brighter)) and "gain" not in str(evaluate(twin))


def test_covered_pixels_are_those_whose_surface_a_training_photo_saw(twin):
    unseen_beyond_mm = 25.0
    z_mm = twin.surface.vertices_mm[:, 2] + twin.surface.origin_mm[2]
    seen_by = np.where(z_mm < unseen_beyond_mm, np.maximum(twin.surface.seen_by, 1), 0).astype(np.int32)
    half = replace(twin, surface=replace(twin.surface, seen_by=seen_by))
    sequence = twin.source.open()
    camera, T_world_camera = sequence.camera, sequence.T_world_camera[0]
    _, depth_mm = tube_sequence.photograph(
        tube_sequence.camera_json(camera.width, camera.height), T_world_camera
    )
    world = camera.pixel_directions @ T_world_camera[:3, :3].T
    point_z_mm = T_world_camera[2, 3] + depth_mm / camera.pixel_directions[..., 2] * world[..., 2]
    hit = Renderer(twin).view(T_world_camera).mask
    expected = (hit & (point_z_mm < unseen_beyond_mm)).mean()
    assert evaluate(half).frames[0].covered == pytest.approx(expected, abs=0.02)


def test_missing_surface_is_black_and_counts_as_error(twin):
    surface = twin.surface
    cut = (surface.vertices_mm[:, 2] + surface.origin_mm[2])[surface.triangles].min(axis=1) < 25.0
    torn = replace(twin, surface=replace(surface, triangles=surface.triangles[cut]))
    sequence = twin.source.open()
    frame = sequence.frame(0)
    valid = sequence.lens_mask & np.isfinite(frame.depth_mm)
    view = Renderer(torn).view(frame.T_world_camera, valid)
    missing = valid & ~view.mask
    inside = cv2.erode(missing.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    error = view.color.astype(np.float64) - frame.color / 255
    assert inside.sum() > 0.02 * valid.sum() and not view.color[inside].any()
    assert evaluate(torn).frames[0].psnr == pytest.approx(
        -10 * np.log10((error[valid] ** 2).mean()), abs=1e-3
    )


def test_the_scores_are_plain_json_and_the_table_says_the_same(twin):
    evaluation = evaluate(twin)
    scores = json.loads(json.dumps(evaluation.to_dict(), allow_nan=False))
    assert list(scores) == JSON_KEYS
    assert scores["light"] == {"L0": 40.0, "n": 2.0, "q": 2.0}
    assert scores["psnr"] == pytest.approx(np.mean([frame["psnr"] for frame in scores["frames"]]))
    assert f"{scores['psnr']:.2f}" in str(evaluation)
    assert f"{scores['psnr']:.2f} dB" in str(twin.with_record(eval=scores))


def test_the_contact_sheet_has_a_row_a_frame_and_three_pictures_a_row(twin, tmp_path):
    evaluation = evaluate(twin, sheet=tmp_path / "sheet.png")
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    assert sheet.shape == (240 * len(evaluation.frames), 3 * 320, 3)
    photo, render = sheet[:200, :320].astype(int), sheet[:200, 320:640].astype(int)
    assert np.abs(photo - render).mean() < 1


def test_a_picture_that_is_there_is_kept_unless_it_may_be_overwritten(twin, tmp_path):
    (tmp_path / "sheet.png").write_text("precious")
    with pytest.raises(OutputError, match="--overwrite"):
        evaluate(twin, tmp_path / "sheet.png")
    assert (tmp_path / "sheet.png").read_text() == "precious"
    evaluate(twin, tmp_path / "sheet.png", overwrite=True)
    assert cv2.imread(str(tmp_path / "sheet.png")) is not None


def test_a_twin_that_does_not_look_like_its_photos_gives_a_warning(twin, caplog):
    evaluate(twin)
    assert not caplog.text
    assert evaluate(replace(twin, light=replace(twin.light, L0=0.2))).psnr < 20
    assert "does not look like its photos" in caplog.text


def test_photos_of_another_size_than_the_twins_are_refused(twin):
    with pytest.raises(SequenceError, match="48×36 at the twin's scale, but the twin was made from 96×72"):
        evaluate(replace(twin, source=replace(twin.source, scale=0.5)))


def test_a_held_out_frame_without_depth_is_skipped_and_named(twin, tmp_path, caplog):
    folder = tube_sequence.write(tmp_path / "tube", frames=10)
    depth = cv2.imread(str(folder / "0008_depth.tiff"), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(folder / "0008_depth.tiff"), np.zeros_like(depth))
    moved = replace(twin, source=replace(twin.source, path=str(folder)))
    assert [frame.index for frame in evaluate(moved).frames] == [0]
    assert "0008_color.png" in caplog.text


def test_a_twin_without_materials_cannot_be_scored(twin):
    with pytest.raises(TwinError, match="endotwin fit"):
        evaluate(replace(twin, materials=None))


def _renders(twin, folder, names) -> None:
    """The twin's own renderings of its held-out frames in 8 bit, as pictures of another method."""
    folder.mkdir()
    renderer, sequence = Renderer(twin), twin.source.open()
    for index, name in zip(twin.source.heldout(len(sequence)), names, strict=True):
        view = renderer.view(sequence.T_world_camera[index], sequence.lens_mask)
        cv2.imwrite(str(folder / name), np.uint8(view.color * 255 + 0.5)[..., ::-1])


@pytest.mark.parametrize(
    "names",
    [
        ("0000_color.png", "0008_color.png"),
        ("frame_0.png", "frame_8.png"),
        ("00000.png", "00001.png"),
    ],
)
def test_renders_of_another_method_are_scored_by_the_twins_own_ruler(twin, tmp_path, names, caplog):
    _renders(twin, tmp_path / "theirs", names)
    own, theirs = evaluate(twin), evaluate(twin, renders=tmp_path / "theirs")
    for mine, other in zip(own.frames, theirs.frames, strict=True):
        assert other.covered == mine.covered
        # 8 bit: the photos are these very pictures, up to the pixels at which a half is rounded
        assert other.psnr > mine.psnr and other.psnr_covered > mine.psnr_covered
    assert ("taken in order" in caplog.text) == (names[1] == "00001.png")
    alone = evaluate(renders=tmp_path / "theirs", sequence=twin.source.path)
    assert [frame.psnr for frame in alone.frames] == [frame.psnr for frame in theirs.frames]
    assert alone.light is None and json.loads(json.dumps(alone.to_dict(), allow_nan=False))["light"] is None
    assert "γ" not in str(alone) and np.isnan(alone.covered)


def test_no_picture_stands_for_two_photos(tmp_path, caplog):
    files = [tmp_path / f"0000{k}.png" for k in range(3)]
    for file in files:
        file.touch()
    photos = SimpleNamespace(color_files=[Path(f"frame{k:04d}_v2.png") for k in range(17)])
    assert list(rendered_files(tmp_path, photos, [0, 8, 16]).values()) == files
    assert "taken in order" in caplog.text


def test_two_pictures_called_alike_are_told_apart_by_nobody(tmp_path):
    for name in ("0000_color.jpg", "0000_color.png", "0008_color.png"):
        (tmp_path / name).touch()
    photos = SimpleNamespace(color_files=[Path(f"{k:04d}_color.png") for k in range(9)])
    with pytest.raises(SequenceError, match=r"0000_color\.jpg and 0000_color\.png"):
        rendered_files(tmp_path, photos, [0, 8])


def test_a_render_that_is_missing_or_of_another_size_is_told(twin, tmp_path):
    _renders(twin, tmp_path / "theirs", ("0000_color.png", "0008_color.png"))
    cv2.imwrite(str(tmp_path / "theirs" / "0008_color.png"), np.zeros((5, 7, 3), np.uint8))
    with pytest.raises(SequenceError, match=r"0008_color\.png is 7×5, but the photos are 96×72"):
        evaluate(twin, renders=tmp_path / "theirs")
    (tmp_path / "theirs" / "0008_color.png").unlink()
    with pytest.raises(SequenceError, match=r"none of held-out frame 0008_color\.png"):
        evaluate(twin, renders=tmp_path / "theirs")


def test_a_twin_is_scored_on_every_frame_of_another_recording_through_its_own_camera(twin, tmp_path):
    folder = tube_sequence.write(tmp_path / "other", frames=3, width=64, height=48)
    other = open_sequence(folder)
    renderer = Renderer(twin, other.camera)
    for index in range(3):
        render = renderer.view(other.T_world_camera[index]).color
        cv2.imwrite(str(other.color_files[index]), np.uint8(render * 255 + 0.5)[..., ::-1])
    scores = evaluate(twin, sequence=folder)
    assert [frame.index for frame in scores.frames] == [0, 1, 2]
    assert scores.psnr == pytest.approx(-10 * np.log10((1 / 255) ** 2 / 12), abs=1.0)
    with pytest.raises(OptionError, match="the twin's own sequence"):
        evaluate(twin, sequence=twin.source.path)
    by_its_file = replace(twin.source.open(), path=Path(twin.source.path) / "transforms.json")
    with pytest.raises(OptionError, match="the twin's own sequence"):
        evaluate(twin, sequence=by_its_file)
    with pytest.raises(OptionError, match="no photos to be compared with"):
        evaluate(renders=tmp_path)


def test_a_half_of_a_photo_tells_where_the_other_half_was_taken(twin):
    sequence = twin.sequence()
    twist = np.r_[np.radians([0.1, -0.15, 0.1]), 0.1, -0.05, 0.1]
    astray = replace(twin, registration=Registration((tuple(twist),) * len(sequence)))
    true, shared = evaluate(twin), evaluate(astray, halves=True)
    assert shared.psnr < true.psnr - 5
    assert shared.mean("psnr_halves") > shared.psnr + 0.7 * (true.psnr - shared.psnr)
    assert "psnr_halves" in str(shared) and "psnr_halves" not in str(true)


def test_pictures_of_another_method_have_no_pose_to_fit(twin, tmp_path):
    with pytest.raises(OptionError, match="--halves"):
        evaluate(sequence=twin.source.path, renders=tmp_path, halves=True)

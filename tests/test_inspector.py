"""The inspector's pictures: all maps, from outside and inside, with and without the sequence."""

import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
import tube_twin

from endotwin.errors import OptionError, OutputError, TrajectoryError
from endotwin.look import inspector
from endotwin.sequence.poses import read_poses
from endotwin.synth import synthesize
from endotwin.synth.trajectories import Trajectory

MAPS = ["base_color", "roughness", "metallic", "coverage", "normals"]
WIDTH, HEIGHT = 240, 180


@pytest.fixture(autouse=True)
def small_tiles(monkeypatch):
    monkeypatch.setattr(inspector, "TILE", (WIDTH, HEIGHT))


@pytest.fixture(scope="module")
def twin():
    return tube_twin.fitted(tube_twin.seen(tube_twin.surface(fold_mm=2.0)))


def tiles(path, columns):
    """Views of a sheet from outside, float [columns, h, W, 3] with h ≤ H, and inside, [columns, H, W, 3]."""
    sheet = cv2.imread(str(path)).astype(float)
    assert HEIGHT < sheet.shape[0] <= 2 * HEIGHT and sheet.shape[1:] == (columns * WIDTH, 3)
    rows = sheet[:-HEIGHT], sheet[-HEIGHT:]
    return [row.reshape(len(row), columns, WIDTH, 3).swapaxes(0, 1) for row in rows]


def test_the_sheet_shows_every_map_from_outside_and_inside(twin, tmp_path):
    inspector.inspect(twin, tmp_path / "sheet.png")
    outside, inside = tiles(tmp_path / "sheet.png", len(MAPS))
    background = outside[0, -1, 0]
    drawn = [(np.abs(row - background).max(axis=-1) > 12).mean(axis=(1, 2)) for row in (outside, inside)]
    assert np.all(drawn[0] > 0.05) and np.all(drawn[0] < 0.8)
    assert np.all(drawn[1] > drawn[0])
    for row in (outside, inside):
        for one in range(len(MAPS)):
            for other in range(one):
                assert np.abs(row[one] - row[other]).mean() > 1, (MAPS[one], MAPS[other])


def test_base_colour_is_drawn_unlit_as_it_is_displayed(twin, tmp_path):
    inspector.inspect(twin, tmp_path / "sheet.png", map="base_color")
    inside = tiles(tmp_path / "sheet.png", 1)[1][0, 100:, :, ::-1].reshape(-1, 3)
    materials = 255 * twin.materials.base_color ** (1 / 2.2)
    wall = inside[np.all(np.abs(inside - np.median(inside, axis=0)) < 80, axis=1)]
    assert len(wall) > 0.6 * len(inside)
    assert np.all(wall.min(axis=0) > materials.min(axis=0) - 4)
    assert np.all(wall.max(axis=0) < materials.max(axis=0) + 4)


def test_an_unfitted_twin_shows_coverage_and_normals_only(twin, tmp_path):
    unfitted = tube_twin.unfitted(twin)
    inspector.inspect(unfitted, tmp_path / "sheet.png")
    assert tiles(tmp_path / "sheet.png", 2)[0].std() > 10
    with pytest.raises(OptionError, match=r"not fitted.*coverage, normals"):
        inspector.inspect(unfitted, tmp_path / "roughness.png", map="roughness")


def test_the_camera_path_is_drawn_where_the_sequence_is(twin, tmp_path):
    poses = np.stack([tube_twin.pose(s) for s in np.linspace(0.1, 1.0, 12)])
    synthesize(twin, Trajectory(poses, np.arange(12.0), "the axis"), tmp_path / "sequence")
    orange = {}
    for name, source in (("with", tmp_path / "sequence"), ("without", tmp_path / "nowhere")):
        shown = tube_twin.fitted(twin.surface, source)
        inspector.inspect(shown, tmp_path / f"{name}.png", map="base_color")
        outside = tiles(tmp_path / f"{name}.png", 1)[0][0]
        orange[name] = (np.abs(outside - (0, 176, 255)).max(axis=-1) < 12).sum()
    assert orange["with"] > 50 and orange["without"] == 0


def test_a_picture_that_cannot_be_made_is_refused_and_nothing_is_left(twin, tmp_path):
    with pytest.raises(OptionError, match="base_color, roughness, metallic, coverage, normals"):
        inspector.inspect(twin, tmp_path / "new.png", map="temperature")
    with pytest.raises(OutputError, match=r"\.png"):
        inspector.inspect(twin, tmp_path / "new.jpg")
    (tmp_path / "taken.png").write_text("precious")
    with pytest.raises(OutputError, match="--overwrite"):
        inspector.inspect(twin, tmp_path / "taken.png")
    assert (tmp_path / "taken.png").read_text() == "precious"
    assert [file.name for file in tmp_path.iterdir()] == ["taken.png"]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="X and Wayland are Linux's displays")
@pytest.mark.parametrize("display", [None, ":99"])
def test_without_a_display_that_answers_the_window_says_what_to_do(twin, monkeypatch, display):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    if display:
        monkeypatch.setenv("DISPLAY", display)
    with pytest.raises(OptionError, match="a PNG file as screenshot"):
        inspector.inspect(twin)


def test_a_saved_keyframe_is_the_view_and_keyframes_add_up(twin, tmp_path):
    stage = inspector.Stage(twin, inspector.twin_maps(twin), off_screen=True)
    pose = tube_twin.pose(0.4)
    stage._plotter.camera_position = [pose[:3, 3], pose[:3, 3] + 5 * pose[:3, 2], -pose[:3, 1]]
    np.testing.assert_allclose(stage.view_pose(), pose, atol=1e-9)
    assert stage.save_keyframe(tmp_path / "keys.txt") == 1
    assert stage.save_keyframe(tmp_path / "keys.txt") == 2
    stage.look_from_outside()
    with pytest.raises(TrajectoryError, match="not from within the lumen"):
        stage.save_keyframe(tmp_path / "keys.txt")
    poses, _ = read_poses(tmp_path / "keys.txt")
    np.testing.assert_allclose(poses, [pose, pose], atol=1e-9)
    stage.look_from_inside()
    (tmp_path / "other.txt").write_text("precious")
    with pytest.raises(TrajectoryError, match="other"):
        stage.save_keyframe(tmp_path / "other.txt")
    assert (tmp_path / "other.txt").read_text() == "precious"


def test_a_slit_behind_a_rim_is_no_crack_from_inside(twin):
    s, _ = tube_twin.to_axis(twin.surface.vertices_mm + twin.surface.origin_mm)
    middle = s[twin.surface.triangles].mean(axis=1)
    whole = np.abs(middle - 0.9) > 0.004
    slit = replace(twin, surface=replace(twin.surface, triangles=twin.surface.triangles[whole]))
    assert 100 < np.count_nonzero(~whole) < 600
    pictures = []
    for each in (twin, slit):
        poses = np.stack([tube_twin.pose(0.5)] * 3)
        stage = inspector.Stage(each, inspector.twin_maps(each), off_screen=True, poses=poses)
        pictures.append(stage.contact_sheet(["base_color"])[-HEIGHT:].astype(float))
    background = np.array([0x14, 0x16, 0x1A])
    dark = [(np.abs(picture - background).max(axis=-1) < 12).sum() for picture in pictures]
    assert dark[1] <= dark[0] + 5


def test_a_window_fits_the_screen_that_it_is_shown_on():
    assert inspector._fitting((1440, 1080), (3840, 2160)) == (1440, 1080)
    for screen in ((1366, 768), (1024, 1366)):
        width, height = inspector._fitting((1440, 1080), screen)
        assert width < screen[0] and height < screen[1] and abs(width / height - 4 / 3) < 0.01


def test_limits_of_a_map_ascend_whatever_its_values():
    for values in ([2.0, 3, 5, 6], [0.5] * 4, [0.0, 1], [1.0] * 3, []):
        low, high = inspector._limits(np.array(values))
        assert 0 <= low < high

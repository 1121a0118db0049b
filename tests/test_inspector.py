"""The inspector's pictures: all maps, from outside and inside, with and without the sequence."""

import cv2
import numpy as np
import pytest
import tube_twin

from endotwin import inspector
from endotwin.errors import OptionError, OutputError
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
    """Float [rows, columns, H, W, 3]: the views of a contact sheet."""
    sheet = cv2.imread(str(path)).astype(float)
    assert sheet.shape == (2 * HEIGHT, columns * WIDTH, 3)
    return sheet.reshape(2, HEIGHT, columns, WIDTH, 3).swapaxes(1, 2)


def test_the_sheet_shows_every_map_from_outside_and_inside(twin, tmp_path):
    inspector.inspect(twin, tmp_path / "sheet.png")
    views = tiles(tmp_path / "sheet.png", len(MAPS))
    background = cv2.imread(str(tmp_path / "sheet.png"))[HEIGHT - 1, 0].astype(float)
    drawn = (np.abs(views - background).max(axis=-1) > 12).mean(axis=(2, 3))
    assert np.all(drawn[0] > 0.05) and np.all(drawn[0] < 0.8)
    assert np.all(drawn[1] > drawn[0])
    for row in views:
        for one in range(len(MAPS)):
            for other in range(one):
                assert np.abs(row[one] - row[other]).mean() > 1, (MAPS[one], MAPS[other])


def test_base_colour_is_drawn_unlit_as_it_is_displayed(twin, tmp_path):
    inspector.inspect(twin, tmp_path / "sheet.png", map="base_color")
    inside = tiles(tmp_path / "sheet.png", 1)[1, 0, 100:, :, ::-1].reshape(-1, 3)
    materials = 255 * twin.materials.base_color ** (1 / 2.2)
    wall = inside[np.all(np.abs(inside - np.median(inside, axis=0)) < 80, axis=1)]
    assert len(wall) > 0.6 * len(inside)
    assert np.all(wall.min(axis=0) > materials.min(axis=0) - 4)
    assert np.all(wall.max(axis=0) < materials.max(axis=0) + 4)


def test_an_unfitted_twin_shows_coverage_and_normals_only(twin, tmp_path):
    unfitted = tube_twin.unfitted(twin)
    inspector.inspect(unfitted, tmp_path / "sheet.png")
    assert tiles(tmp_path / "sheet.png", 2).std() > 10
    with pytest.raises(OptionError, match=r"not fitted.*coverage, normals"):
        inspector.inspect(unfitted, tmp_path / "roughness.png", map="roughness")


def test_the_camera_path_is_drawn_where_the_sequence_is(twin, tmp_path):
    poses = np.stack([tube_twin.pose(s) for s in np.linspace(0.1, 1.0, 12)])
    synthesize(twin, Trajectory(poses, np.arange(12.0), "the axis"), tmp_path / "sequence")
    orange = {}
    for name, source in (("with", tmp_path / "sequence"), ("without", tmp_path / "nowhere")):
        shown = tube_twin.fitted(twin.surface, source)
        inspector.inspect(shown, tmp_path / f"{name}.png", map="base_color")
        outside = tiles(tmp_path / f"{name}.png", 1)[0, 0]
        orange[name] = (np.abs(outside - (0, 176, 255)).max(axis=-1) < 12).sum()
    assert orange["with"] > 50 and orange["without"] == 0


def test_a_picture_that_cannot_be_made_is_refused_and_nothing_is_left(twin, tmp_path):
    with pytest.raises(OptionError, match="base_color, roughness, metallic, coverage, normals"):
        inspector.inspect(twin, tmp_path / "new.png", map="temperature")
    with pytest.raises(OptionError, match=r"\.png"):
        inspector.inspect(twin, tmp_path / "new.jpg")
    (tmp_path / "taken.png").write_text("precious")
    with pytest.raises(OutputError, match="--overwrite"):
        inspector.inspect(twin, tmp_path / "taken.png")
    assert (tmp_path / "taken.png").read_text() == "precious"
    assert [file.name for file in tmp_path.iterdir()] == ["taken.png"]


def test_without_a_display_the_window_says_what_to_do(twin, monkeypatch):
    monkeypatch.setattr(inspector.sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(OptionError, match="--screenshot"):
        inspector.inspect(twin)

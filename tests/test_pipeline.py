"""The Python API: the names that the README uses, what may be fused and fitted, and the runnable examples."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
import tube_sequence

import endotwin

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.mark.parametrize("name", endotwin.__all__)
def test_every_public_name_is_there_and_documented(name):
    assert getattr(endotwin, name).__doc__


def test_a_name_that_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match="twine"):
        endotwin.twine  # noqa: B018


def test_importing_endotwin_imports_no_library():
    code = (
        "import sys, endotwin; sys.exit(bool({'numpy', 'torch', 'open3d', 'vtk', 'cv2'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_held_out_depth_shapes_the_surface_only_with_known_geometry(tmp_path):
    folder = tube_sequence.write(tmp_path / "tube", frames=9)
    before = {geometry: endotwin.fuse_twin(folder, geometry=geometry) for geometry in ("known", "heldout")}
    raw = tifffile.imread(folder / "0008_depth.tiff")
    tifffile.imwrite(folder / "0008_depth.tiff", np.uint16(raw * 0.9))
    after = {geometry: endotwin.fuse_twin(folder, geometry=geometry) for geometry in ("known", "heldout")}
    same = {
        name: np.array_equal(before[name].surface.vertices_mm, after[name].surface.vertices_mm)
        for name in before
    }
    assert same == {"known": False, "heldout": True}


def test_held_out_photos_are_never_counted_or_fitted(tmp_path, monkeypatch):
    folder = tube_sequence.write(tmp_path / "tube", frames=9)
    twin = endotwin.fuse_twin(folder)
    assert twin.surface.seen_by.max() == 7
    read, color = [], endotwin.Sequence.color
    monkeypatch.setattr(
        endotwin.Sequence, "color", lambda self, index: read.append(index) or color(self, index)
    )
    endotwin.fit_twin(twin, budget_s=1)
    assert set(read) == {1, 2, 3, 4, 5, 6, 7}


def test_frames_that_are_left_out_are_not_even_read_and_the_others_keep_their_part(tmp_path):
    folder = tube_sequence.write(tmp_path / "tube", frames=9)
    for name in ("0003_color.png", "0003_depth.tiff", "0008_color.png"):
        (folder / name).write_bytes(b"torn")
    endotwin.fit_twin(endotwin.fuse_twin(folder, without=[8, 3]), budget_s=1).save(tmp_path / "twin")
    twin = endotwin.Twin.load(tmp_path / "twin")
    assert (twin.source.training(9), twin.source.heldout(9)) == ([1, 2, 4, 5, 6, 7], [0])
    assert twin.surface.seen_by.max() == 6
    assert [frame.index for frame in endotwin.evaluate(twin).frames] == [0]
    with pytest.raises(endotwin.EndotwinError, match="no frame 9 to leave out: its frames are 0 to 8"):
        endotwin.fuse_twin(folder, without=[9])
    with pytest.raises(endotwin.EndotwinError, match="no frame 3 to leave out"):
        endotwin.fuse_twin(folder, without="3")
    with pytest.raises(endotwin.EndotwinError, match="no frame to fit"):
        endotwin.fuse_twin(folder, without=range(1, 8))


def test_a_saved_twin_opens_its_sequence_from_any_folder(tmp_path, monkeypatch):
    tube_sequence.write(tmp_path / "tube", frames=9)
    monkeypatch.chdir(tmp_path)
    endotwin.fuse_twin("tube").save(tmp_path / "twin")
    monkeypatch.chdir("/")
    assert len(endotwin.Twin.load(tmp_path / "twin").source.open()) == 9


def test_a_single_frame_makes_a_twin_that_has_nothing_to_score(tmp_path):
    twin = endotwin.fuse_twin(tube_sequence.write(tmp_path / "tube", frames=1))
    twin = endotwin.fit_twin(twin, budget_s=1)
    with pytest.raises(endotwin.EndotwinError, match="held-out"):
        endotwin.evaluate(twin)


def test_the_custom_sequence_example_runs(tmp_path):
    command = [EXAMPLES / "custom_sequence.py", tmp_path / "custom", "--frames", "9", "--budget", "1"]
    done = subprocess.run([sys.executable, *command], capture_output=True, text=True, encoding="utf-8")
    assert done.returncode == 0, done.stderr
    assert "held out:" in done.stdout
    assert len(endotwin.open_sequence(tmp_path / "custom" / "dataset")) == 8

"""Damaged files: every reader and every command answers with one sentence, never with a traceback."""

import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
import tube_sequence
from command_line import invoke
from damage import WRITERS, Files, damaged, files_of
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import endotwin
from endotwin.errors import EndotwinError

FEW = settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
FEWER = settings(FEW, max_examples=10)


@pytest.fixture(scope="module", params=sorted(WRITERS))
def sequence(request, tmp_path_factory) -> Files:
    folder = tmp_path_factory.mktemp("fuzz") / request.param
    folder.mkdir()
    return files_of(WRITERS[request.param](folder))


@FEW
@given(data=st.data())
def test_a_reader_gives_sound_frames_or_one_sentence(sequence, data):
    path, spoilt = data.draw(damaged(sequence))
    folder = min(sequence, key=lambda file: len(file.parts)).parent
    path.write_bytes(spoilt)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            read_all(folder)
    except EndotwinError as error:
        assert str(error) and "\n" not in str(error)
    finally:
        path.write_bytes(sequence[path])


def read_all(folder: Path) -> None:
    opened = endotwin.open_sequence(folder)
    size = (opened.camera.height, opened.camera.width)
    for index in range(len(opened)):
        frame = opened.frame(index)
        assert frame.color.shape == (*size, 3) and frame.depth_mm.shape == size
        assert not np.isinf(frame.depth_mm).any() and not (frame.depth_mm <= 0).any()
        assert np.isfinite(frame.T_world_camera).all()
    assert opened.lens_mask.shape == size
    lengths = np.linalg.norm(opened.camera.pixel_directions, axis=2)
    np.testing.assert_allclose(lengths[np.isfinite(lengths)], 1, atol=1e-5)


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A sequence ``tube`` and its fitted twin ``twin``."""
    folder = tmp_path_factory.mktemp("made")
    tube_sequence.write(folder / "tube", 4, 48, 36)
    endotwin.fit_twin(endotwin.fuse_twin(folder / "tube")).save(folder / "twin")
    return folder


def spoil_and_run(contents: Files, data: st.DataObject, out: Path, *command: object) -> None:
    path, spoilt = data.draw(damaged(contents))
    path.write_bytes(spoilt)
    try:
        code = invoke(*command)
        assert code in (0, 2)
        assert out.exists() == (code == 0)
    finally:
        path.write_bytes(contents[path])
        shutil.rmtree(out, ignore_errors=True) if out.is_dir() else out.unlink(missing_ok=True)


@FEWER
@given(data=st.data())
def test_fuse_of_a_damaged_sequence_is_a_twin_or_one_sentence(made, data):
    out = made / "out"
    spoil_and_run(files_of(made / "tube"), data, out, "fuse", made / "tube", "-o", out)


@settings(FEW, max_examples=20)
@given(data=st.data(), command=st.sampled_from(["fit", "synth", "eval"]))
def test_commands_on_a_damaged_twin_or_its_sequence_are_done_or_one_sentence(made, data, command):
    out = made / ("out.png" if command == "eval" else "out")
    arguments = {
        "fit": ("fit", made / "twin", "-o", out, "--budget", 2),
        "synth": ("synth", made / "twin", "--trajectory", "jitter:frames=2", "-o", out),
        "eval": ("eval", made / "twin", "--sheet", out),
    }[command]
    spoil_and_run(Files({**files_of(made / "twin"), **files_of(made / "tube")}), data, out, *arguments)

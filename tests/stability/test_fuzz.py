"""Damaged files: every reader and every command answers with one sentence, never with a traceback."""

import json
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh
import tube_sequence
import tube_twin
from command_line import invoke
from damage import WRITERS, Files, damaged, files_of
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import endotwin
from endotwin.config import load_config
from endotwin.errors import EndotwinError, OptionError, TwinError
from endotwin.synth import Variation, read_variation

pytestmark = pytest.mark.slow

FEW = settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
FEWER = settings(FEW, max_examples=10)
WORDS = [
    "per",
    "clip",
    "material",
    "light",
    "response",
    "regions",
    "effects",
    "parameters",
    "fuse",
    "fit",
    "box",
]
WORDS += ["name", "vertices", "scale", "voxel", "frames", "method", "budget", "noise", "gain"]


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


def spoil_and_run(contents: Files, data: st.DataObject, out: Path, *command: object) -> None:
    path, spoilt = data.draw(damaged(contents))
    path.write_bytes(spoilt)
    try:
        code = invoke(*command)
        assert code in ((0, 1, 2) if command[0] == "check" else (0, 2))
        assert out.exists() == (code == 0) or out.name == "nothing"
    finally:
        path.write_bytes(contents[path])
        shutil.rmtree(out, ignore_errors=True) if out.is_dir() else out.unlink(missing_ok=True)


@FEWER
@given(data=st.data())
def test_fuse_of_a_damaged_sequence_is_a_twin_or_one_sentence(made, data):
    out = made / "out"
    spoil_and_run(files_of(made / "tube"), data, out, "fuse", made / "tube", "-o", out)


COMMANDS = {
    "align twin -o out": "out",
    "align twin --align off -o out --against tube/pose.txt": "out",
    "check dataset --labels": None,
    "effects twin": None,
    "eval twin --sheet out.png": "out.png",
    "eval --renders renders --sequence tube": None,
    "eval twin --sequence tube": None,
    "export twin out.glb": "out.glb",
    "fit twin -o out --budget 2": "out",
    "inspect twin --screenshot out.png --map coverage": "out.png",
    "synth twin --trajectory jitter:frames=2 --camera tube/camera.json -o out": "out",
    "synth twin --trajectory tube/pose.txt -o out": "out",
    "synth twin --trajectory jitter:frames=2 --effects like=tube -o out": "out",
    "synth twin --trajectory spline:keyframes.txt,frames=2 --vary ranges.json -o out": "out",
}
"""What each writes."""


@pytest.fixture(scope="module")
def inputs(made, monkeypatch_module) -> Path:
    """The folder to stand in: all that commands read."""
    shutil.copytree(made / "tube", made / "renders", ignore=shutil.ignore_patterns("*_depth.tiff", "*.txt"))
    tube_sequence.write(made / "other", 3, 40, 30)
    shutil.copy(made / "tube" / "pose.txt", made / "keyframes.txt")
    ranges = {"light": ["intensity*0.5..2"], "material": ["roughness*0.8..1.2"]}
    (made / "ranges.json").write_text(json.dumps(ranges))
    monkeypatch_module.chdir(made)
    assert invoke("synth", "twin", "--trajectory", "jitter:frames=2", "--labels", "all", "-o", "dataset") == 0
    return made


def read_by(inputs: Path, command: str) -> Files:
    """The files that a command reads."""
    contents = files_of(inputs / "twin")
    contents.update(files_of(inputs / "tube"))
    for name in ("renders", "dataset", "other", "keyframes.txt", "ranges.json"):
        if name in command:
            path = inputs / name
            contents.update(files_of(path) if path.is_dir() else {path: path.read_bytes()})
    return contents


@settings(FEW, max_examples=90)
@given(data=st.data(), command=st.sampled_from(sorted(COMMANDS)))
def test_commands_on_damaged_inputs_are_done_or_one_sentence(inputs, data, command):
    out = inputs / (COMMANDS[command] or "nothing")
    spoil_and_run(read_by(inputs, command), data, out, *command.split())


class Begun(BaseException):
    """The long work starts."""


def begin(*_: object, **__: object) -> None:
    raise Begun


@pytest.mark.parametrize(
    ("command", "work"),
    [
        ("tradeoff other -o out", "endotwin.tradeoff.run.measured"),
        (
            "study depth --real tube --twin twin --test other -o out --network small --frames 2 --seeds 1",
            "endotwin.study.run.train",
        ),
    ],
    ids=["tradeoff", "study"],
)
@settings(FEW, max_examples=40)
@given(data=st.data())
def test_a_long_command_on_damaged_inputs_begins_with_sound_frames_or_says_one_sentence(
    inputs, command, work, data
):
    contents = files_of(inputs / "other")
    if "twin" in command:
        contents.update(read_by(inputs, command))
    path, spoilt = data.draw(damaged(contents))
    path.write_bytes(spoilt)
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(work, begin)
            assert invoke(*command.split()) == 2
        assert not list(inputs.glob("out*"))
    except Begun:
        read_all(inputs / "other")
        endotwin.Twin.load(inputs / "twin")
    finally:
        path.write_bytes(contents[path])
        shutil.rmtree(inputs / "out.partial", ignore_errors=True)


@FEWER
@given(data=st.data())
def test_check_of_a_damaged_sequence_names_a_finding_or_says_one_sentence(made, data):
    contents = files_of(made / "tube")
    path, spoilt = data.draw(damaged(contents))
    path.write_bytes(spoilt)
    try:
        assert invoke("check", made / "tube", "--json") in (0, 1, 2)
    finally:
        path.write_bytes(contents[path])


@FEW
@given(data=st.data())
def test_a_flipped_bit_in_a_twin_is_told_wherever_a_rendering_depends_on_it(made, data):
    whole = endotwin.Twin.load(made / "twin")
    contents = files_of(made / "twin")
    path = data.draw(st.sampled_from(sorted(contents)))
    spoilt = bytearray(contents[path])
    spoilt[data.draw(st.integers(0, len(spoilt) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(spoilt)
    try:
        loaded = endotwin.Twin.load(made / "twin")
    except TwinError as error:
        assert str(error) and "\n" not in str(error)
    else:
        assert path.name == "twin.json" and loaded.seal == whole.seal
    finally:
        path.write_bytes(contents[path])


TWIN = tube_twin.fitted(tube_twin.surface())
YAML = st.one_of(
    st.text(max_size=40),
    st.sampled_from(["[", "{a: ", "- ", "? "]).map(lambda opening: opening * 20_000),
    st.recursive(
        st.one_of(st.none(), st.booleans(), st.floats(), st.integers(), st.text(max_size=8)),
        lambda inner: (
            st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(WORDS), inner, max_size=3)
        ),
        max_leaves=8,
    ).map(lambda value: json.dumps(value, ensure_ascii=False)),
)


@pytest.fixture(scope="module")
def painted(made) -> Files:
    """Files that say which vertices belong to a region, and the ranges that name each."""
    folder = made / "painted"
    folder.mkdir()
    weight = np.linspace(0, 1, len(TWIN.surface.vertices_mm))
    np.save(folder / "weight.npy", weight)
    mesh = trimesh.creation.box()
    mesh.visual.vertex_colors = np.uint8(30 * np.arange(8))[:, None].repeat(4, axis=1)
    mesh.export(folder / "weight.ply")
    for suffix in (".npy", ".ply"):
        region = {"name": "polyp", "vertices": f"weight{suffix}", "material": ["roughness*1.2"]}
        (folder / f"ranges{suffix}.json").write_text(json.dumps({"regions": [region]}))
        read_variation(folder / f"ranges{suffix}.json", TWIN, Variation())
    return files_of(folder)


@FEW
@given(data=st.data())
def test_damaged_files_of_a_region_are_read_or_told_in_one_sentence(made, painted, data):
    path, spoilt = data.draw(damaged(painted))
    path.write_bytes(spoilt)
    try:
        for suffix in (".npy", ".ply"):
            read_variation(made / "painted" / f"ranges{suffix}.json", TWIN, Variation())
    except EndotwinError as error:
        assert str(error) and "\n" not in str(error)
    finally:
        path.write_bytes(painted[path])


@settings(FEW, max_examples=100)
@given(text=YAML, marked=st.booleans())
def test_any_text_is_a_config_or_ranges_or_one_sentence(made, text, marked):
    file = made / "any.yaml"
    file.write_text(text, encoding="utf-8-sig" if marked else "utf-8", errors="replace")
    for read in (load_config, lambda path: read_variation(path, TWIN, Variation())):
        try:
            read(file)
        except OptionError as error:
            assert str(error) and "\n" not in str(error)

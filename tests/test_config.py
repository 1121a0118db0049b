"""Configs: presets and files say what they mean, and mistakes are told by file and key."""

from itertools import pairwise
from pathlib import Path

import pytest
import tube_sequence
import yaml
from endotwin.cli.main import main
from hypothesis import given
from hypothesis import strategies as st

import endotwin
from endotwin.config import (
    METHODS,
    STANDARD,
    Config,
    FitConfig,
    FuseConfig,
    from_document,
    load_config,
    preset_names,
    seconds,
    to_yaml,
)
from endotwin.errors import OptionError

positive = st.floats(1e-3, 1e3, allow_nan=False)
configs = st.builds(
    Config,
    fuse=st.builds(FuseConfig, scale=positive, voxel=positive, frames=st.none() | st.integers(1, 10_000)),
    fit=st.builds(
        FitConfig,
        method=st.sampled_from(METHODS),
        pixels=st.integers(1, 10**9),
        detail=positive,
        steps=st.integers(0, 100),
        budget=st.none() | positive,
    ),
)


def test_the_presets_ship_with_the_package_and_standard_is_the_default():
    assert {"draft", "standard", "fine"} <= set(preset_names())
    assert load_config("standard") == STANDARD == Config()


def test_each_preset_looks_at_more_than_the_one_before():
    draft, standard, fine = (load_config(name) for name in ("draft", "standard", "fine"))
    assert draft.fit.pixels < standard.fit.pixels < fine.fit.pixels
    assert draft.fuse.scale / draft.fuse.voxel < standard.fuse.scale / standard.fuse.voxel
    assert standard.fuse.scale / standard.fuse.voxel < fine.fuse.scale / fine.fuse.voxel


@given(configs)
def test_a_config_written_as_yaml_reads_back_as_it_was(config):
    assert from_document(yaml.safe_load(to_yaml(config)), "file") == config


def test_what_a_file_leaves_out_is_as_in_standard(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("fit: {steps: 5, budget: 2m}\n")
    assert load_config(file) == Config(fit=FitConfig(steps=5, budget=120.0))
    file.write_text("# nothing yet\n")
    assert load_config(file) == Config()


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("fit: {stepz: 3}", ["stepz", "steps"]),
        ("fits: {steps: 3}", ["fits", "fuse, fit"]),
        ("fit: {steps: 2.5}", ["fit.steps", "2.5", "whole number"]),
        ("fit: {steps: -1}", ["fit.steps", "at least 0"]),
        ("fit: {pixels: 0}", ["fit.pixels", "at least 1"]),
        ("fit: {pixels: many}", ["fit.pixels", "many"]),
        ("fit: {steps: true}", ["fit.steps", "True"]),
        ("fit: {method: magic}", ["fit.method", "endopbr"]),
        ("fit: {budget: soon}", ["fit.budget", "soon"]),
        ("fuse: {scale: 0}", ["fuse.scale", "greater than 0"]),
        ("fuse: {scale: .nan}", ["fuse.scale", "number"]),
        pytest.param(f"fuse: {{scale: 1{'0' * 400}}}", ["fuse.scale", "number"], id="huge"),
        pytest.param(f"fit: {{pixels: 1{'0' * 400}}}", ["fit.pixels", "number"], id="huge whole"),
        ("fuse: {scale: null}", ["fuse.scale", "number"]),
        ("fuse: 3", ["fuse", "3"]),
        ("- fuse", ["keys with values"]),
        ("fuse: {scale: [", ["not YAML"]),
        pytest.param("{a: " * 20_000, ["not YAML", "nested too deeply"], id="deep"),
    ],
)
def test_a_mistake_in_a_file_is_one_sentence_with_the_file_and_the_key(tmp_path, text, told):
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    with pytest.raises(OptionError) as error:
        load_config(file)
    message = str(error.value)
    assert "\n" not in message and all(word in message for word in [str(file), *told])


@pytest.mark.parametrize("name", ["quick", "nowhere.yaml", ""])
def test_a_config_that_is_not_there_is_told_with_what_there_is(name):
    with pytest.raises(OptionError, match=r"draft, fine, standard|nowhere\.yaml cannot be read"):
        load_config(name)


@pytest.mark.parametrize(
    ("text", "value"), [("10", 10), ("10s", 10), ("2m", 120), ("1.5h", 5400), (0.5, 0.5), (" 3 S ", 3)]
)
def test_a_budget_is_seconds_minutes_or_hours(text, value):
    assert seconds(text) == value


@pytest.mark.parametrize("text", ["", "s", "-1", "0", "ten", "10 days", "nan", "inf", "1e999s"])
def test_a_budget_that_is_no_time_is_refused(text):
    with pytest.raises(OptionError, match="10s"):
        seconds(text)


@pytest.fixture(scope="module")
def tube(tmp_path_factory) -> Path:
    return tube_sequence.write(tmp_path_factory.mktemp("config") / "tube", frames=10)


def run(monkeypatch, *arguments: object) -> int:
    monkeypatch.setattr("sys.argv", ["endotwin", *map(str, arguments)])
    with pytest.raises(SystemExit) as exit_:
        main()
    return exit_.value.code or 0


def test_options_win_over_the_config_and_the_config_over_the_default(tube, tmp_path, monkeypatch):
    mine, twin = tmp_path / "mine.yaml", tmp_path / "twin"
    mine.write_text("fuse: {scale: 0.5, frames: 4}\nfit: {method: endopbr, steps: 0}\n")
    assert run(monkeypatch, "fuse", tube, "-o", twin, "--config", mine) == 0
    fused = endotwin.Twin.load(twin)
    assert fused.source.scale == 0.5 and fused.camera.width == 48
    assert fused.source.frames == 4 and fused.record["fuse"]["frames"] == 4 + 2
    assert run(monkeypatch, "fit", twin, "--config", mine, "--method", "twin") == 0
    assert endotwin.Twin.load(twin).record["fit"]["method"] == "twin"
    assert run(monkeypatch, "fuse", tube, "-o", twin, "--overwrite", "--config", mine, "--scale", 1) == 0
    assert endotwin.Twin.load(twin).camera.width == 96


def test_a_larger_voxel_factor_gives_a_coarser_mesh(tube):
    vertices = [
        len(endotwin.fuse_twin(tube, config=FuseConfig(voxel=voxel)).surface.vertices_mm)
        for voxel in (2.0, 1.0)
    ]
    assert 1.5 * vertices[0] < vertices[1]


def test_of_too_many_training_frames_evenly_spread_ones_are_used_and_no_held_out_one():
    source = endotwin.twin.Source("sequence", "c3vd", frames=10)
    used = source.training(1000)
    assert len(used) == 10 and not set(used) & set(source.heldout(1000))
    assert max(abs(b - a - 999 / 9) for a, b in pairwise(used)) < 3
    assert source.training(8) == [1, 2, 3, 4, 5, 6, 7]

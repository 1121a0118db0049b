"""The depth experiment as a user runs it: what it trains on, what it refuses, what it writes."""

import csv
import io
import json
import os
import shutil
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
import tube_sequence
from command_line import invoke
from endotwin.cli import console
from faults import killed_at_every_operation

import endotwin
from endotwin.errors import OptionError, OutputError, TwinError
from endotwin.sequence.readers import open_sequence
from endotwin.study import parse_parts, study_depth
from endotwin.study.accuracy import METRICS
from endotwin.study.arms import HEADLINE, TASTED, arms
from endotwin.study.corruptions import CORRUPTIONS
from endotwin.study.frames import kept, of_dataset, of_sequence
from endotwin.study.leak import LeakError, require_unseen
from endotwin.study.recipe import EVERYTHING, INGREDIENTS, RENDERED
from endotwin.study.report import Findings, answer
from endotwin.study.run import Plan
from endotwin.synth import read_variation
from endotwin.synth.variation import Variation
from endotwin.twin import Twin


@pytest.fixture(scope="module")
def other(made):
    """A sequence of other photos than the twin's."""
    return tube_sequence.write(made / "other", 3, 40, 30)


@pytest.fixture
def study(made, other, capfd):
    """Run ``endotwin study depth`` on the twin: exit code, stdout, stderr."""

    def run(*arguments: object, test: Path = other) -> tuple[int, str, str]:
        capfd.readouterr()
        inputs = ("--real", made / "tube", "--twin", made / "twin", "--test", test, "--network", "small")
        code = invoke("study", "depth", *inputs, "--frames", 4, "--steps", 2, "--seeds", 1, *arguments)
        return code, *capfd.readouterr()

    return run


@pytest.mark.slow
def test_all_parts_end_in_a_table_a_plot_and_a_page(study, tmp_path):
    code, out, err = study("--parts", "all", "-o", tmp_path / "s")
    assert code == 0, err
    assert {file.name for file in (tmp_path / "s").iterdir()} == {
        *("depth.csv", "depth.png", "depth.svg", "depth.html"),
        *("study.json", "results", "networks", "recipes"),
    }
    names = [arm.name for arm in (*HEADLINE, *TASTED)]
    assert all(name in out for name in names) and "AbsRel" in out
    rows = list(csv.DictReader(io.StringIO((tmp_path / "s" / "depth.csv").read_text(encoding="utf-8"))))
    assert [row["arm"] for row in rows[::2]] == names
    assert all(0 < float(row[metric]) < 1000 for row in rows for metric in METRICS[:4])
    page = (tmp_path / "s" / "depth.html").read_text(encoding="utf-8")
    assert all(name in page for name in (*names, *CORRUPTIONS))
    assert "endotwin synth TWIN --trajectory jitter:" in page and "none of the photos and depth maps" in page
    assert [entry.name for entry in tmp_path.iterdir()] == ["s"]


@pytest.mark.slow
def test_a_stopped_study_goes_on_to_the_same_numbers_and_more_parts_go_on_from_them(
    study, tmp_path, monkeypatch
):
    assert study("-o", tmp_path / "whole")[0] == 0

    def stop(self, label, done, total):
        if (label, done, total) == ("train", 5, 6):
            os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(console.Run, "progress", stop)
        code, out, err = study("-o", tmp_path / "parted")
    assert (code, out) == (130, "") and "the same command goes on" in err and err.count("\n") == 1
    assert not (tmp_path / "parted").exists()
    results = set((tmp_path / "parted.partial" / "results").iterdir())
    assert 2 <= len(results) <= 3  # the third may have done its last step by then
    trained = []

    def watch(self, label, done, total):
        if label == "train":
            trained.append(total)

    monkeypatch.setattr(console.Run, "progress", watch)
    assert study("-o", tmp_path / "parted")[0] == 0
    assert set(trained) == ({2 * (3 - len(results))} - {0})
    whole, parted = ((tmp_path / name / "depth.csv").read_text() for name in ("whole", "parted"))
    assert whole == parted
    trained.clear()
    assert study("-o", tmp_path / "parted", "--parts", "ingredients", "--overwrite")[0] == 0
    assert set(trained) == {2 * len(TASTED)}
    page = (tmp_path / "parted" / "depth.html").read_text(encoding="utf-8")
    assert f"-o {RENDERED.name}-0" in page  # which an earlier run has rendered
    assert parted.splitlines()[:7] == (tmp_path / "parted" / "depth.csv").read_text().splitlines()[:7]


def test_a_test_that_the_twin_was_made_from_is_refused_under_any_name(made, study, tmp_path):
    shutil.copytree(made / "tube", tmp_path / "renamed")
    for test in (made / "tube", tmp_path / "renamed"):
        code, out, err = study("-o", tmp_path / "s", test=test)
        assert (code, out) == (2, "")
        assert err.startswith("error: ") and err.count("\n") == 1 and "cannot be a test" in err
    assert [entry.name for entry in tmp_path.iterdir()] == ["renamed"]


def test_one_photo_or_one_depth_map_in_common_is_a_leak(made, other, tmp_path):
    twins = {made / "twin": Twin.load(made / "twin")}
    for name in ("0002_color.png", "0002_depth.tiff"):
        mixed = tube_sequence.write(tmp_path / name, 3, 48, 36)
        for file in mixed.glob("*_*"):
            if file.name != name:
                blacken(file)
        with pytest.raises(LeakError, match="knows 1 of its photos"):
            require_unseen([open_sequence(mixed)], [], twins)
    assert "none of the photos" in require_unseen([open_sequence(other)], [], twins)[0]


def blacken(file: Path) -> None:
    """Change the pixels of a photo or depth map."""
    image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    image[: len(image) // 2] = image[0, 0] // 2
    cv2.imwrite(str(file), image)


def test_a_test_that_is_trained_on_is_refused(made, other):
    with pytest.raises(LeakError, match="--real"):
        require_unseen([open_sequence(other)], [open_sequence(other)], {})


def test_a_copy_is_a_leak_though_the_twin_was_made_at_another_scale(made, tmp_path):
    shutil.copytree(made / "tube", tmp_path / "renamed")
    small = endotwin.fuse_twin(made / "tube", scale=0.5)
    with pytest.raises(LeakError, match="knows 8 of its photos"):
        require_unseen([open_sequence(tmp_path / "renamed")], [], {Path("twin"): small})


def test_a_twin_whose_sequence_is_gone_is_refused_in_a_sentence_that_names_both(made, study, tmp_path):
    shutil.copytree(made / "tube", tmp_path / "lost")
    endotwin.fit_twin(endotwin.fuse_twin(tmp_path / "lost")).save(tmp_path / "twin")
    shutil.rmtree(tmp_path / "lost")
    code, _, err = study("--twin", tmp_path / "twin", "-o", tmp_path / "s")
    assert code == 2 and err.count("\n") == 1
    assert f"{tmp_path / 'twin'} cannot be compared with the tests" in err and "lost, from which" in err
    assert [entry.name for entry in tmp_path.iterdir()] == ["twin"]


def empty(folder: Path) -> None:
    """No depth in any frame."""
    for file in folder.glob("*_depth.tiff"):
        tifffile.imwrite(file, np.zeros_like(tifffile.imread(file)))


def black(folder: Path) -> None:
    """Every photo black."""
    for file in folder.glob("*_color.png"):
        cv2.imwrite(str(file), np.zeros_like(cv2.imread(str(file))))


@pytest.mark.parametrize("role", ["--real", "--twin", "--test"])
def test_an_input_that_is_named_twice_is_refused(made, other, study, tmp_path, role):
    again = {"--real": made / "tube", "--twin": made / "twin", "--test": other}[role]
    code, _, err = study(role, again, "-o", tmp_path / "s")
    assert code == 2 and f"is named twice as {role}" in err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("spoil", "told"), [(empty, "no depth within 100 mm"), (black, "only black photos")])
@pytest.mark.parametrize("role", ["--real", "--test"])
def test_what_cannot_be_learned_from_or_judged_by_is_refused_before_any_training(
    made, study, tmp_path, role, spoil, told
):
    spoil(tube_sequence.write(tmp_path / "spoilt", 3, 44, 33))
    code, _, err = study(role, tmp_path / "spoilt", "-o", tmp_path / "s")
    assert code == 2 and err.startswith("error: ") and err.count("\n") == 1, err
    assert "spoilt" in err and told in err
    assert [entry.name for entry in tmp_path.iterdir()] == ["spoilt"]


@pytest.fixture
def stopped(made, other, tmp_path, monkeypatch):
    """A study that was stopped as it began to train; going on with it."""

    def stop(*_):
        raise KeyboardInterrupt

    def go_on():
        study_depth([made / "tube"], [made / "twin"], [other], tmp_path / "s", Plan(network="small"))

    with monkeypatch.context() as patch:
        patch.setattr("endotwin.study.run.train", stop)
        with pytest.raises(KeyboardInterrupt):
            go_on()
    return go_on


def test_a_study_does_not_go_on_with_a_network_of_other_widths(stopped, monkeypatch):
    monkeypatch.setattr("endotwin.study.small.WIDTHS", (16, 24, 48, 96, 192))
    with pytest.raises(OutputError, match="another study or network"):
        stopped()


@pytest.mark.long
def test_a_study_does_not_go_on_from_frames_that_were_changed(stopped, other, tmp_path):
    changed = tmp_path / "changed"
    shutil.copytree(other, changed)
    blacken(changed / "0001_depth.tiff")
    other.rename(tmp_path / "kept")
    changed.rename(other)
    try:
        with pytest.raises(OutputError, match="of other frames; delete it"):
            stopped()
    finally:
        shutil.rmtree(other)
        (tmp_path / "kept").rename(other)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--parts", "headline,tail"], "tail"),
        (["--loss", "l2"], "huber"),
        pytest.param(["--network", "nowhere"], "weights of Depth Anything", marks=pytest.mark.slow),
        (["--seeds", "0"], "seeds"),
        (["--frames", "0"], "frames"),
        (["--steps", "-1"], "steps"),
        (["--device", "tpu"], "tpu"),
        (["--twin", "nowhere"], "nowhere"),
        (["--test", "nowhere"], "nowhere"),
    ],
    ids=" ".join,
)
def test_what_makes_no_sense_is_refused_in_one_line_and_nothing_is_left(study, tmp_path, options, told):
    code, out, err = study("-o", tmp_path / "s", *options)
    assert (code, out) == (2, "")
    assert err.startswith("error: ") and err.count("\n") == 1 and told in err, err
    assert list(tmp_path.iterdir()) == []


def test_a_twin_that_is_not_fitted_is_refused(made, other, tmp_path):
    endotwin.fuse_twin(made / "tube").save(tmp_path / "fused")
    with pytest.raises(TwinError, match="endotwin fit"):
        study_depth([made / "tube"], [tmp_path / "fused"], [other], tmp_path / "s", Plan(network="small"))


def test_frames_of_a_dataset_are_those_that_were_rendered(made, tmp_path):
    """Photos and depth of a webdataset against the same dataset as C3VD's reader has it."""
    twin = made / "twin"
    for layout in ("webdataset", "c3vd"):
        endotwin.synthesize(
            twin, "jitter:frames=3,rotation=2", tmp_path / layout, layout=layout, labels="rgb,depth,mask"
        )
    sequence = open_sequence(tmp_path / "c3vd")
    size = (sequence.camera.width, sequence.camera.height)
    lit = np.ones(size[::-1], bool)
    lit[:, :7] = False
    for index, (color, depth_mm) in enumerate(of_dataset(tmp_path / "webdataset", size, lit)):
        assert np.array_equal(color[lit], sequence.color(index)[lit]) and not color[~lit].any()
        expected = np.where(lit, sequence.depth_mm(index), np.nan)
        assert np.nanmax(np.abs(depth_mm - expected)) < 1e-4
        assert np.isfinite(depth_mm).sum() <= np.isfinite(expected).sum() and np.isnan(depth_mm[~lit]).all()
    assert index == 2


def test_kept_frames_are_read_again_unless_something_else_is_asked(other, tmp_path):
    sequence, size = open_sequence(other), (20, 16)
    frames = kept(of_sequence(sequence, size), 3, size, tmp_path / "f", {"source": "a"})
    assert frames.color.shape == (3, 16, 20, 3) and frames.depth_mm.shape == (3, 16, 20)
    again = kept(iter(()), 3, size, tmp_path / "f", {"source": "a"})
    assert np.array_equal(again.color, frames.color)
    blind = [(color, np.full_like(depth_mm, np.nan)) for color, depth_mm in (frames[0], frames[1])]
    with pytest.raises(OptionError, match="b has no depth"):
        kept(iter(blind), 2, size, tmp_path / "f", {"source": "b"})
    assert len(frames.some(2)) == 2 and len(frames.some(9)) == 3


def test_frames_that_were_being_kept_when_the_run_was_killed_are_made_again(tmp_path):
    image = np.arange(36, dtype=np.uint8).reshape(3, 4, 3)
    frames = [(image + shift, np.full((3, 4), 9.0 + shift)) for shift in range(2)]

    def work() -> None:
        kept(iter(frames), 2, (4, 3), tmp_path / "f", {"source": "a"})

    def look() -> None:
        again = kept(iter(frames), 2, (4, 3), tmp_path / "f", {"source": "a"})
        assert all(np.array_equal(again[index][0], color) for index, (color, _) in enumerate(frames))
        assert all(np.array_equal(again[index][1], depth_mm) for index, (_, depth_mm) in enumerate(frames))
        shutil.rmtree(tmp_path / "f")

    assert killed_at_every_operation(work, look) >= 15


def test_recipes_are_ranges_that_synth_understands_and_all_has_every_one(made, tmp_path):
    twin = Twin.load(made / "twin")
    for recipe in (*INGREDIENTS, RENDERED, EVERYTHING):
        recipe.write(tmp_path / "vary.yaml")
        drawn = read_variation(tmp_path / "vary.yaml", twin, Variation()).to_dict()
        for key, values in recipe.vary.items():
            assert len(drawn[key]) == len(values)
    assert RENDERED.lenses and EVERYTHING.lenses and EVERYTHING.codec
    for key in ("material", "light", "response", "parameters"):
        assert EVERYTHING.vary[key] == [each for recipe in INGREDIENTS for each in recipe.vary.get(key, [])]


def test_arms_of_the_curve_have_fewer_frames_than_there_are():
    names = [arm.name for arm in arms(parse_parts("curve"), 500)]
    assert names == ["real", "rendered", "both", "rendered@50", "rendered@100", "rendered@200"]
    assert json.dumps(parse_parts("all")) == '["headline", "ingredients", "curve", "robustness"]'


@pytest.mark.parametrize(
    ("real", "rendered", "both", "told"),
    [
        ((0.2, 0.202, 0.198), (0.1, 0.101, 0.099), (0.05, 0.051, 0.049), ("better than", "better than")),
        ((0.1, 0.101, 0.099), (0.2, 0.202, 0.198), (0.3, 0.302, 0.298), ("worse than", "worse than")),
        ((0.060, 0.064, 0.062), (0.058, 0.064, 0.061), (0.060, 0.068, 0.064), ("like", "as good as")),
    ],
)
def test_no_difference_is_claimed_that_seeds_alone_would_make(real, rendered, both, told):
    runs = {
        name: [[{"metric": {"abs_rel": value}}] for value in values]
        for name, values in (("real", real), ("rendered", rendered), ("both", both))
    }
    said = answer(Findings({"tests": ["cecum"], "seeds": 3}, list(HEADLINE), runs, []))
    assert f"{told[0]} on real ones" in said and f"both together are {told[1]} the better" in said


def test_each_test_has_its_own_robustness_however_many_there_are(tmp_path):
    (tmp_path / "results").mkdir()
    for test in range(12):
        (tmp_path / "results" / f"robustness.{test}.json").write_text(json.dumps({"test": test}))
    found = Findings.read(tmp_path, [], 1, {"tests": [f"test {test}" for test in range(12)]})
    assert [each["test"] for each in found.robustness] == list(range(12))

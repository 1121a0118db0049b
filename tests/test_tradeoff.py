"""The ladder: what is measured is what was run, the front and its knee are what they are defined to be."""

import csv
import json
import re
import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest
import tube_sequence
from command_line import in_one_process
from endotwin.cli.main import main
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from endotwin.config import Config, FitConfig, FuseConfig, load_config, preset_names
from endotwin.effects import RENDERED
from endotwin.errors import OptionError, OutputError
from endotwin.sequence.readers import open_sequence
from endotwin.tradeoff import LADDER, effects, ladder, run, tradeoff
from endotwin.tradeoff.crops import telling_patch
from endotwin.tradeoff.knee import knee, pareto_front
from endotwin.tradeoff.measure import stages
from endotwin.twin import Source

pytestmark = pytest.mark.slow

points = st.integers(1, 30).flatmap(
    lambda count: st.tuples(
        arrays.arrays(float, count, elements=st.floats(0.1, 1000)),
        arrays.arrays(float, count, elements=st.floats(10, 50)),
    )
)


@given(points)
def test_no_point_beats_one_of_the_front_and_every_other_is_beaten(measured):
    seconds, score = measured
    front = pareto_front(seconds, score)
    beats = (seconds[:, None] <= seconds) & (score[:, None] >= score)
    beats &= (seconds[:, None] < seconds) | (score[:, None] > score)
    assert not beats[:, front].any()
    for index in set(range(len(score))) - set(front):
        assert beats[:, index].any() or any(
            (seconds[index], score[index]) == (seconds[other], score[other]) for other in front
        )
    assert sorted(seconds[front]) == list(seconds[front]) and sorted(score[front]) == list(score[front])


def test_a_score_that_is_not_a_number_is_on_no_front():
    assert pareto_front(np.array([1.0, 2, 3]), np.array([np.nan, 5, 6])) == [1, 2]


@given(st.floats(0.01, 100), st.floats(0.1, 10), st.floats(-20, 20))
def test_the_knee_is_the_bend_of_a_bent_line_in_any_unit(minute, gain, offset):
    """PSNR rises by 5 dB a doubling for three doublings, then by 0.5 dB."""
    doublings = np.arange(8.0)
    score = np.minimum(5 * doublings, 15 + 0.5 * (doublings - 3))
    assert knee(minute * 2**doublings, gain * score + offset) == 3


def test_a_straight_front_and_a_front_of_two_have_no_knee():
    assert knee(np.array([1.0, 2]), np.array([30.0, 40])) is None
    assert knee(np.array([1.0, 2, 4]), np.array([30.0, 29, 28])) is None
    assert knee(np.array([1.0, 2, 4, 8]), np.array([30.0, 30.5, 32, 40])) is None


def test_the_ladder_turns_every_knob_and_holds_the_presets_and_endopbr():
    rungs = ladder(None, "60s")
    assert {"preset", "scale", "voxel", "pixels", "detail", "steps", "tilts", "budget", "endopbr"} == {
        rung.knob for rung in rungs
    }
    assert set(preset_names()) < {rung.name for rung in rungs} and len(rungs) == len(LADDER) + 1
    assert rungs[-1].config.fit == FitConfig(method="endopbr", budget=60.0)


def test_a_rung_is_a_preset_a_file_or_changes_of_one(tmp_path):
    mine = tmp_path / "mine.yaml"
    mine.write_text("fit: {steps: 7}")
    names = f"draft,voxel=2,draft+steps=0+budget=3s,{mine},endopbr"
    preset, voxel, both, file, endopbr = ladder(names, "5s")
    assert preset.config == load_config("draft") and preset.given == "draft"
    assert voxel.config == Config(FuseConfig(voxel=2.0)) and voxel.given is None
    assert both.config.fuse == preset.config.fuse and (both.config.fit.steps, both.config.fit.budget) == (
        0,
        3,
    )
    assert file.config == Config(fit=FitConfig(steps=7)) and file.given == str(mine)
    assert endopbr.config.fit.method == "endopbr" and endopbr.config.fit.budget == 5


def test_a_rung_may_force_effects_of_a_preset_a_file_or_turned_knobs(tmp_path):
    mine = tmp_path / "mine.yaml"
    mine.write_text("fit: {steps: 7}\neffects: {coat: on}")
    preset, turned, file, many = ladder(
        f"gain=on,voxel=2+gain=off,{mine}+gain=on,draft+coat=on+gain=off", "5s"
    )
    assert (preset.name, preset.given, preset.effects) == ("standard+gain=on", "standard", "gain=on")
    assert preset.config == Config(effects={"gain": "on"})
    assert preset.commands(Path("s"), "standard", "known")[1] == [
        "fit",
        "twin",
        "--effects",
        "gain=on",
        "--seed",
        "0",
    ]
    assert turned.config == Config(FuseConfig(voxel=2.0), effects={"gain": "off"}) and turned.given is None
    assert (file.name, file.given) == ("mine+gain=on", str(mine))
    assert file.config == Config(fit=FitConfig(steps=7), effects={"coat": "on", "gain": "on"})
    assert many.effects == "coat=on,gain=off" and many.config.fit == load_config("draft").fit


@pytest.mark.parametrize(
    ("names", "told"),
    [
        ("gain=perhaps", "gain=perhaps"),
        ("gloss=2", "no knob"),
        ("quick", "there is no config 'quick'"),
        ("voxel=0", "rung 'voxel=0': fuse.voxel"),
        ("draft,draft", "twice"),
        ("budget=soon", "soon"),
        ("voxel=[", r"rung 'voxel=\['.*no value"),
        ("voxel=2024-13-45", "rung 'voxel=2024-13-45'"),
    ],
)
def test_a_rung_that_means_nothing_is_refused(names, told):
    with pytest.raises(OptionError, match=told):
        ladder(names, "60s")


def test_the_stages_add_up_to_the_seconds_of_the_commands():
    fuse = {
        "command": "fuse",
        "seconds": 10.0,
        "parts": {"fuse": {"open": 1, "TSDF": 3, "carve": 2, "carve again": 2}},
    }
    fit = {"command": "fit", "seconds": 7.0, "parts": {"fit": {"gather": 2, "start": 1, "detail": 3}}}
    shares = stages(fuse, fit)
    assert shares == {
        "start-up and files": 4.0,
        "TSDF": 3,
        "carve": 4,
        "gather": 2,
        "closed form": 1,
        "detail": 3,
    }
    assert sum(shares.values()) == pytest.approx(17)


def test_the_machine_has_the_cores_that_the_process_may_use(monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 64)
    monkeypatch.setattr("os.sched_getaffinity", lambda process: {0, 5, 9}, raising=False)
    assert run.machine().startswith("3 cores, ")


def test_the_patch_is_lit_and_where_the_detail_is(tmp_path):
    """A photo that is flat but for a checkered corner, and a frame whose brighter checkers are clipped."""
    folder = tube_sequence.write(tmp_path / "tube", frames=3)
    photo = np.full((72, 96, 3), 120, np.uint8)
    photo[40:60, 60:80] += np.uint8(40 * (np.indices((20, 20)).sum(axis=0) % 2))[..., None]
    photo[5:25, 5:25] = np.uint8(255 * (np.indices((20, 20)).sum(axis=0) % 2))[..., None]
    for file in folder.glob("*_color.png"):
        cv2.imwrite(str(file), photo)
    sequence = open_sequence(folder)
    patch = telling_patch(sequence, Source(str(folder), "c3vd"))
    assert patch.frame == 0 and patch.size == 18
    assert 38 <= patch.row <= 44 and 58 <= patch.column <= 64
    assert patch.of(photo).shape == (18, 18, 3)


class Interrupted(BaseException):
    """As Ctrl-C would."""


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[Path, list[dict], int]:
    """Two rungs and an effect, stopped in the second and run again: folder, rows, count of measurements. The
    first rung's commands have processes of their own."""
    work = tmp_path_factory.mktemp("tradeoff")
    tube = tube_sequence.write(work / "tube", 9, 48, 36)
    rungs, calls, measured = ladder("steps=0,voxel=3+steps=0", "1s"), [], run.measured

    def stopped_once(*arguments):
        calls.append(arguments)
        if len(calls) == 2:
            raise Interrupted
        return measured(*arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "measured", stopped_once)
        with pytest.raises(Interrupted) as stopped:
            tradeoff(tube, work / "out", rungs, repeats=1)
        assert not (work / "out").exists()
        assert stopped.value.__notes__ == [f"the same command goes on from {work / 'out.partial'}"]
        with pytest.raises(OutputError, match=r"out\.partial holds the results of another sequence"):
            tradeoff(tube, work / "out", rungs, repeats=1, geometry="heldout")
        patch.setattr(effects, "FITTED", ("coat",))
        in_one_process(patch)
        rows, _ = tradeoff(tube, work / "out", rungs, repeats=1, base=effects.base("steps=0"))
    return work / "out", rows, len(calls)


@pytest.mark.long
def test_a_stopped_run_goes_on_where_it_was(made):
    out, rows, calls = made
    assert calls == 3 and len(rows) == 2
    assert not out.with_name("out.partial").exists()
    assert {entry.name for entry in out.iterdir()} == {
        "crops", "ladder.json", "results", "rungs", "effects", "effects.csv", "effects.png", "effects.svg",
        "tradeoff.csv", "tradeoff.html", "tradeoff.png", "tradeoff.svg",
    }  # fmt: skip


@pytest.mark.long
def test_the_csv_holds_each_rung_with_its_stages_and_command(made):
    out, rows, _ = made
    with (out / "tradeoff.csv").open(encoding="utf-8") as file:
        written = list(csv.DictReader(file))
    assert [line["rung"] for line in written] == ["steps=0", "voxel=3+steps=0"]
    for line, row in zip(written, rows, strict=True):
        assert float(line["psnr"]) == pytest.approx(row["psnr"], rel=1e-5)
        shares = [float(value) for name, value in line.items() if name.endswith(" s")]
        assert sum(shares) == pytest.approx(float(line["seconds"]), rel=0.02)
        assert float(line["peak_memory_mb"]) > 100
        assert line["commands"].startswith("endotwin fuse ")


@pytest.mark.long
def test_the_command_of_a_rung_names_a_config_that_is_that_rung(made):
    out, rows, _ = made
    for row, rung in zip(rows, ladder("steps=0,voxel=3+steps=0", "1s"), strict=True):
        fuse, fit, score = row["commands"]
        assert load_config(fuse[fuse.index("--config") + 1]) == rung.config
        assert load_config(fit[fit.index("--config") + 1]) == rung.config
        assert (fuse[0], fit[0], score[0]) == ("fuse", "fit", "eval")
    assert out.name in " ".join(rows[0]["commands"][0])


@pytest.mark.long
def test_each_effect_has_its_line_beside_the_fit_that_decided_it(made):
    """One was forced on, in a tube that has none; what no fit needs is priced only."""
    out, _, _ = made
    assert {entry.name for entry in (out / "effects").iterdir()} == {"results", "rungs"}
    with (out / "effects.csv").open(encoding="utf-8") as file:
        written = {line["effect"]: line for line in csv.DictReader(file)}
    assert set(written) == {effects.AS_DECIDED, "coat", *RENDERED}
    plain, coat = written[effects.AS_DECIDED], written["coat"]
    assert (coat["state"], coat["forced"]) == ("off", "on") and float(plain["frame_ms"]) > 0
    assert float(coat["psnr"]) - float(plain["psnr"]) == pytest.approx(float(coat["psnr_gain"]), abs=1e-3)
    assert "fit twin --config" in coat["commands"] and "--effects coat=on" in coat["commands"]
    assert float(written["motion_blur"]["render_ms"]) > 0 and written["motion_blur"]["psnr"] == ""
    page = (out / "tradeoff.html").read_text(encoding="utf-8")
    assert all(f"<td>{effect}</td>" in page for effect in ("coat", *RENDERED))


@pytest.mark.long
def test_the_page_stands_alone_and_tells_every_rung(made):
    out, rows, _ = made
    page = (out / "tradeoff.html").read_text(encoding="utf-8")
    sources = re.findall(r"(?:src|href)=[\"']([^\"']{5})", page)
    assert len(sources) == 2 + 1 + len(rows) and set(sources) == {"data:"}
    assert "<script" not in page and "@import" not in page
    for row in rows:
        assert row["rung"] in page and f"{row['psnr']:.2f}" in page
        assert shlex.join(["endotwin", *row["commands"][0]]) in page.replace("&#x27;", "'")
    for picture in [out / "tradeoff.png", *(out / "crops").iterdir()]:
        assert cv2.imread(str(picture)).std() > 1


@pytest.mark.long
def test_the_results_tell_the_scores_that_eval_gave(made):
    out, rows, _ = made
    for row in rows:
        result = json.loads((out / "results" / f"{row['rung']}.0.json").read_text())
        assert result["psnr"] == row["psnr"] and 15 < row["psnr"] < 60
        assert sum(result["stages"].values()) == pytest.approx(result["seconds"], rel=0.02)


@pytest.mark.long
@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--rungs", "gloss=2"], "no knob"),
        (["--repeats", "0"], "at least 1"),
        (["--budget", "soon", "--rungs", "endopbr"], "soon"),
        (["--effects", "method=endopbr"], "fits no effects"),
        (["--effects", "gloss=2"], "no knob"),
        (["--geometry", "all", "--rungs", "draft"], "known, heldout"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(made, tmp_path, monkeypatch, capsys, options, told):
    tube = made[0].parent / "tube"
    monkeypatch.setattr(
        "sys.argv", ["endotwin", "tradeoff", str(tube), "-o", str(tmp_path / "out"), *options]
    )
    with pytest.raises(SystemExit) as exit_:
        main()
    err = capsys.readouterr().err
    assert exit_.value.code == 2 and err.startswith("error: ") and told in err and err.count("\n") == 1
    assert not list(tmp_path.iterdir())

"""``endotwin synth`` as a user types it: what it writes, how it stops, goes on, and refuses."""

import json
import os
import re
import signal
import sys

import numpy as np
import pytest
import tube_twin
from endotwin.cli import console
from endotwin.cli import synth as command
from endotwin.cli.main import main

from endotwin.anatomy import CLASSES
from endotwin.sequence.poses import write_c3vd_poses
from endotwin.sequence.readers import open_sequence
from endotwin.synth import DEFAULT_LABELS, LABELS, LAYOUTS
from endotwin.synth.fluids import FLUIDS
from endotwin.synth.motion.kinds import KINDS

FRAMES = 40


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a twin, a pose file of its lumen, a camera and a file of ranges."""
    folder = tmp_path_factory.mktemp("made")
    tube_twin.fitted(tube_twin.seen(tube_twin.surface())).save(folder / "twin")
    write_c3vd_poses(
        folder / "poses.txt", np.stack([tube_twin.pose(s) for s in np.linspace(0.1, 0.9, FRAMES)])
    )
    camera = {"model": "pinhole", "width": 64, "height": 48, "fx": 40, "fy": 40, "cx": 31.5, "cy": 23.5}
    (folder / "camera.json").write_text(json.dumps(camera))
    (folder / "vary.yaml").write_text("light: [intensity*0.5..1.5]\n")
    return folder


@pytest.fixture
def synth(made, capfd):
    """Run ``endotwin synth`` on the twin along the poses: exit code, stdout, stderr."""

    def run(*arguments: object, trajectory: object = made / "poses.txt") -> tuple[int, str, str]:
        capfd.readouterr()
        typed = ["endotwin", "synth", made / "twin", "--trajectory", trajectory, *arguments]
        with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as exit_:
            patch.setattr(sys, "argv", list(map(str, typed)))
            main()
        return exit_.value.code or 0, *capfd.readouterr()

    return run


def test_layout_labels_lens_and_variation_are_as_they_were_asked_for(made, synth, tmp_path):
    code, out, err = synth(
        *("--layout", "tum", "--labels", "rgb,depth,occlusion", "--camera", made / "camera.json"),
        *("--vary", made / "vary.yaml", "--max-unseen", 0.9, "--seed", 7, "-o", tmp_path / "d"),
    )
    assert code == 0, err
    assert f"{tmp_path / 'd'}: {FRAMES} frames" in out
    sequence = open_sequence(tmp_path / "d")
    assert (sequence.format, len(sequence), sequence.camera.width) == ("tum", FRAMES, 64)
    document = json.loads((tmp_path / "d" / "dataset.json").read_text())
    assert document["seed"] == 7 and document["labels"] == ["rgb", "depth", "occlusion"]
    assert (
        len({record["light"][0] for record in map(json.loads, (tmp_path / "d" / "frames.jsonl").open())}) > 9
    )


def test_polyps_bring_their_label_and_their_table(synth, tmp_path):
    polyps = ("--polyp", "Is:size=4,count=2", "--polyp", "IIa:size=6")
    code, _, err = synth(*polyps, "--layout", "flat", "-o", tmp_path / "d")
    assert code == 0, err
    document = json.loads((tmp_path / "d" / "dataset.json").read_text())
    assert document["labels"] == [*DEFAULT_LABELS, "polyp"]
    assert [(each["number"], each["paris"]) for each in document["polyps"]] == [
        *((1, "0-Is"), (2, "0-Is"), (3, "0-IIa"))
    ]
    assert len(list((tmp_path / "d" / "polyp").iterdir())) == FRAMES


def test_fluids_bring_their_label_and_their_table(synth, tmp_path):
    fluids = ("--fluid", "blood:size=6,count=2", "--fluid", "mucus:size=6")
    code, _, err = synth(*fluids, "--layout", "flat", "-o", tmp_path / "d")
    assert code == 0, err
    document = json.loads((tmp_path / "d" / "dataset.json").read_text())
    assert document["labels"] == [*DEFAULT_LABELS, "fluid"]
    assert [(each["number"], each["kind"]) for each in document["fluids"]] == [
        *((1, "blood"), (2, "blood"), (3, "mucus"))
    ]
    assert len(list((tmp_path / "d" / "fluid").iterdir())) == FRAMES


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stopped_run_says_that_the_same_command_goes_on_and_it_does(
    synth, tmp_path, monkeypatch, number, code
):
    with monkeypatch.context() as patch:
        patch.setattr(console.Run, "progress", lambda *_: os.kill(os.getpid(), number))
        stopped = synth("-o", tmp_path / "d")
    assert stopped[0] == code and stopped[1] == ""
    assert stopped[2].startswith("stopped; what is done is kept in") and stopped[2].count("\n") == 1
    assert not (tmp_path / "d").exists() and (tmp_path / "d.partial").exists()
    counted = []
    monkeypatch.setattr(console.Run, "progress", lambda self, label, done, total: counted.append(done))
    assert synth("-o", tmp_path / "d")[0] == 0
    assert counted == [16, 32, 40]
    assert [entry.name for entry in tmp_path.iterdir()] == ["d"]


def test_progress_shows_frames_a_second():
    run = console.Run()
    run.progress("render", 10, 100)
    run.progress("render", 30, 100)
    assert re.fullmatch(r"30/100 · [\d.]+/s", run.bars.tasks[-1].fields["count"])


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ([], "--preview"),
        (["-o", "{new}", "--preview", "{new}.png"], "--preview"),
        (["-o", "{new}", "--labels", "rgb,smell"], "smell"),
        (["-o", "{new}", "--layout", "betamax"], "webdataset"),
        (["-o", "{new}", "--camera", "nowhere.json"], "nowhere.json"),
        (["-o", "{new}", "--vary", "nowhere.yaml"], "nowhere.yaml"),
        (["-o", "{new}", "--clearance", "-1"], "clearance"),
        (["-o", "{new}", "--max-unseen", "2"], "unseen"),
        (["-o", "{new}", "--effects", "noise=auto"], "noise=on or off"),
        (["-o", "{new}", "--max-distance", "5"], "nowhere"),
        (["-o", "{new}", "--workers", "-1"], "workers"),
        (["-o", "{new}", "--motion", "swallowing"], "peristalsis or breathing"),
        (["-o", "{new}", "--motion", "breathing:period=0"], "period"),
        (["-o", "{new}", "--labels", "scene_flow"], "--motion"),
        (["-o", "{new}", "--effects", "like=nowhere"], "nowhere"),
        (["-o", "{new}", "--polyp", "III"], "Ip or Is or IIa"),
        (["-o", "{new}", "--polyp", "Is:size=25"], "choose a smaller size"),
        (["-o", "{new}", "--polyp", "Is:x=0,y=0,z=900"], "from the surface"),
        (["-o", "{new}", "--labels", "polyp"], "--polyp"),
        (["-o", "{new}", "--fluid", "paint"], "blood or mucus or stool"),
        (["-o", "{new}", "--fluid", "stool:pool=1"], "true or false"),
        (["-o", "{new}", "--labels", "fluid"], "--fluid"),
        (["--preview", "{new}.jpg"], "png"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_options_that_make_no_sense_are_refused_in_one_line_and_nothing_is_left(
    synth, tmp_path, options, told
):
    code, out, err = synth(*[option.format(new=tmp_path / "new") for option in options])
    assert (code, out) == (2, "")
    assert err.startswith("error: ") and err.count("\n") == 1 and told in err, err
    assert list(tmp_path.iterdir()) == []


def test_the_help_names_all_labels_and_layouts():
    options = command.synth.__annotations__
    assert all(label in command.LABELS for label in LABELS)
    assert all(kind in str(options["motion"]) for kind in KINDS)
    assert all(layout in str(options["layout"]) for layout in LAYOUTS)
    assert all(kind in str(options["polyp"]) for kind in CLASSES)
    assert all(kind in str(options["fluid"]) for kind in FLUIDS)
    assert command.synth.__kwdefaults__ is None
    assert ",".join(DEFAULT_LABELS) in str(options["labels"])

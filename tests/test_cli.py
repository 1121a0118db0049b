"""The command line: the whole afternoon of a user, and every mistake that a user can make."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
import tube_sequence
from command_line import invoke
from endotwin.cli import console
from endotwin.cli.stop import Stopped, heed_signals

from endotwin.evaluation.evaluation import MEANS

FRAMES = 10


@pytest.fixture
def endotwin(capfd) -> Callable[..., tuple[int, str, str]]:
    """``invoke``, which also gives what was printed: exit code, stdout, stderr."""

    def run(*arguments: object) -> tuple[int, str, str]:
        capfd.readouterr()
        code = invoke(*arguments)
        return code, *capfd.readouterr()

    return run


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A folder with a sequence ``tube`` and its fitted twin ``twin``; tests must not change them."""
    folder = tmp_path_factory.mktemp("made")
    tube_sequence.write(folder / "tube", FRAMES)
    assert invoke("fuse", folder / "tube", "-o", folder / "twin") == 0
    assert invoke("fit", folder / "twin", "--budget", 3) == 0
    return folder


@pytest.fixture
def tube(tmp_path) -> Path:
    """A sequence that a test may spoil."""
    return tube_sequence.write(tmp_path / "tube", FRAMES)


@pytest.fixture
def fails(endotwin, tmp_path) -> Callable[..., str]:
    """Run a command that must fail as promised: exit code 2, one line on stderr, nothing left behind."""

    def run(*arguments: object) -> str:
        before = sorted(tmp_path.rglob("*"))
        code, out, err = endotwin(*arguments)
        assert code == 2, err
        assert err.startswith("error: ") and err.count("\n") == 1, err
        assert out == ""
        assert sorted(tmp_path.rglob("*")) == before
        return err

    return run


def edit_poses(folder: Path, change: Callable[[np.ndarray], None]) -> None:
    """Rewrite pose.txt after ``change`` has altered its matrices in place."""
    poses = tube_sequence.poses(FRAMES)
    change(poses)
    tube_sequence.write_poses(folder / "pose.txt", poses)


# The afternoon


def test_a_sequence_becomes_a_twin_scores_a_dataset_and_a_picture(endotwin, made, tmp_path):
    twin, dataset, sheet, picture = (tmp_path / name for name in ("twin", "dataset", "sheet.png", "twin.png"))
    shutil.copytree(made / "twin", twin)

    code, out, _ = endotwin("eval", twin, "--json", "--sheet", sheet)
    scores = json.loads(out)
    assert code == 0
    assert list(scores) == [*MEANS, "lpips_network", "gamma", "light", "frames"]
    assert [frame["index"] for frame in scores["frames"]] == [0, 8]
    assert scores["psnr_covered"] > 25
    assert sheet.is_file()

    code, out, _ = endotwin(
        "synth", twin, "--trajectory", "jitter:frames=3", "--light", "intensity*0.8", "-o", dataset
    )
    assert code == 0 and str(dataset) in out
    code, out, err = endotwin(
        "fuse", dataset, "-o", tmp_path / "again", "--profile", tmp_path / "profile.json"
    )
    assert code == 0 and str(tmp_path / "again") in out, err
    assert json.loads((tmp_path / "profile.json").read_text())["stages"]["fuse"] > 0

    code, out, _ = endotwin("inspect", twin, "--screenshot", picture)
    assert code == 0 and str(picture) in out
    assert cv2.imread(str(picture)).std() > 1


def test_eval_keeps_the_scores_in_the_twin_and_says_that_lpips_is_missing(
    endotwin, made, tmp_path, monkeypatch
):
    from endotwin.evaluation import metrics
    from endotwin.twin import Twin

    monkeypatch.setattr(metrics, "_lpips_network", lambda name: None)
    shutil.copytree(made / "twin", tmp_path / "twin")
    code, out, _ = endotwin("eval", tmp_path / "twin")
    assert code == 0 and "not installed" in out
    kept = Twin.load(tmp_path / "twin").record["eval"]
    code, _, err = endotwin("eval", tmp_path / "twin", "--lpips", "vgg")
    assert code == 2 and "endotwin[lpips]" in err
    assert kept["lpips"] is None and f"{kept['psnr']:.2f} dB" in repr(Twin.load(tmp_path / "twin"))


def test_the_twin_remembers_its_protocol_and_heldout_geometry_uses_fewer_frames(endotwin, tube, tmp_path):
    from endotwin.twin import Twin

    code, _, err = endotwin("fuse", tube, "-o", tmp_path / "twin", "--geometry", "heldout", "--scale", "0.5")
    assert code == 0, err
    twin = Twin.load(tmp_path / "twin")
    assert (twin.source.geometry, twin.source.scale) == ("heldout", 0.5)
    assert twin.record["fuse"]["frames"] == FRAMES - 2
    assert (twin.camera.width, twin.camera.height) == (48, 36)


def test_a_frame_that_is_all_invalid_is_skipped_with_a_warning_that_names_it(endotwin, tube, tmp_path):
    tifffile.imwrite(tube / "0003_depth.tiff", np.zeros((72, 96), np.uint16))
    code, _, err = endotwin("fuse", tube, "-o", tmp_path / "twin")
    assert code == 0
    warnings = [line for line in err.splitlines() if line.startswith("warning: ")]
    assert len(warnings) == 1 and "0003_depth.tiff" in warnings[0]


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda T: np.divide(T[:, :3, 3], 1000, out=T[:, :3, 3]), "endotwin check"),
        (lambda T: np.copyto(T, T @ np.diag([1, -1, -1, 1.0])), "endotwin check"),
        (lambda T: np.multiply(T[:, :3, 3], 1000, out=T[:, :3, 3]), "unit"),
        (lambda T: np.add(T[5, :3, 3], 1e9, out=T[5, :3, 3]), "0005_color.png"),
        (lambda T: np.add(T[5:7, :3, 3], 1e6, out=T[5:7, :3, 3]), "0006_color.png"),
        (lambda T: np.add(T[5, :3, 3], (3, 0, 0), out=T[5, :3, 3]), "0005_depth.tiff"),
    ],
    ids=["metres", "OpenGL's axes", "micrometres", "one far away", "two far away", "one beside its place"],
)
def test_poses_that_the_depth_contradicts_give_a_warning_that_names_the_suspect(
    endotwin, tube, tmp_path, spoil, says
):
    edit_poses(tube, spoil)
    code, _, err = endotwin("fuse", tube, "-o", tmp_path / "twin")
    assert code == 0, err
    warnings = [line for line in err.splitlines() if line.startswith("warning: ")]
    assert len(warnings) == 1 + says.startswith("0006") and says in warnings[-1]


def test_help_is_instant_because_nothing_slow_is_imported():
    code = (
        "import sys; sys.argv = ['endotwin', '--help']\n"
        "from endotwin.cli.main import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "slow = {'torch', 'open3d', 'vtk', 'pyvista', 'matplotlib', 'numpy', 'scipy', 'cv2', 'skimage'}\n"
        "sys.exit(f'imported {slow & set(sys.modules)}' if slow & set(sys.modules) else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, encoding="utf-8")
    assert done.returncode == 0, done.stderr
    assert all(command in done.stdout for command in ("fuse", "fit", "eval", "synth", "tradeoff", "study"))


@pytest.mark.parametrize(
    "command", ["fuse", "fit", "eval", "synth", "inspect", "export", "tradeoff", "study", "study depth"]
)
def test_every_command_explains_itself_with_an_example(endotwin, command):
    code, out, _ = endotwin(*command.split(), "--help")
    assert code == 0 and f"endotwin {command}" in out and "Example" in out


def test_version_is_that_of_the_package(endotwin):
    from importlib.metadata import version

    assert endotwin("--version")[:2] == (0, f"endotwin {version('endotwin')}\n")


def test_ctrl_c_in_the_middle_of_an_import_stops_the_command_after_it(tmp_path, monkeypatch):
    (tmp_path / "a_library.py").write_text(
        "import os, signal\n"
        "try:\n    os.kill(os.getpid(), signal.SIGINT)\n    str()\n"
        "except BaseException:\n    raise ImportError('as C extensions do')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    heed_signals()
    with pytest.raises(Stopped):
        import a_library  # noqa: F401

        time.sleep(10)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stopped_command_leaves_nothing_behind(endotwin, tube, tmp_path, monkeypatch, number, code):
    monkeypatch.setattr(console.Run, "progress", lambda *_: os.kill(os.getpid(), number))
    before = sorted(tmp_path.rglob("*"))
    result = endotwin("fuse", tube, "-o", tmp_path / "twin")
    assert result == (code, "", "stopped; nothing was written\n")
    assert sorted(tmp_path.rglob("*")) == before


# Bad input: the sequence


def test_no_such_folder(fails, tmp_path):
    assert "nowhere" in fails("fuse", tmp_path / "nowhere", "-o", tmp_path / "twin")


def test_no_frames(fails, tmp_path):
    (tmp_path / "empty").mkdir()
    assert "no frames" in fails("fuse", tmp_path / "empty", "-o", tmp_path / "twin")


def test_frames_and_poses_of_different_count(fails, tube, tmp_path):
    lines = (tube / "pose.txt").read_text().splitlines()
    (tube / "pose.txt").write_text("\n".join(lines[:-1]) + "\n")
    message = fails("fuse", tube, "-o", tmp_path / "twin")
    assert "10 frames" in message and "9 poses" in message


def test_a_pose_that_is_not_rigid(fails, tube, tmp_path):
    def stretch(poses: np.ndarray) -> None:
        poses[4, :3, :3] *= 1.1

    edit_poses(tube, stretch)
    message = fails("fuse", tube, "-o", tmp_path / "twin")
    assert "pose.txt" in message and "rigid" in message and "transpose" not in message


def test_a_pose_whose_transpose_would_be_rigid(fails, tube, tmp_path):
    poses = tube_sequence.poses(FRAMES)
    tube_sequence.write_poses(tube / "pose.txt", poses.swapaxes(1, 2))
    assert "transpose" in fails("fuse", tube, "-o", tmp_path / "twin")


def test_nan_in_a_pose(fails, tube, tmp_path):
    def spoil(poses: np.ndarray) -> None:
        poses[2, 0, 3] = np.nan

    edit_poses(tube, spoil)
    assert "pose.txt" in fails("fuse", tube, "-o", tmp_path / "twin")


def test_depth_and_colour_of_different_size(fails, tube, tmp_path):
    tifffile.imwrite(tube / "0005_depth.tiff", np.full((36, 48), 20000, np.uint16))
    message = fails("fuse", tube, "-o", tmp_path / "twin")
    assert "0005_depth.tiff" in message and "48×36" in message


@pytest.mark.parametrize("name", ["0006_depth.tiff", "0000_color.png"])
def test_a_truncated_image(fails, tube, tmp_path, name):
    file = tube / name
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    assert name in fails("fuse", tube, "-o", tmp_path / "twin")


def test_a_photo_truncated_after_the_fusion_is_found_by_the_fit(fails, made, tmp_path):
    shutil.copytree(made / "tube", tmp_path / "tube")
    shutil.copytree(made / "twin", tmp_path / "twin")
    twin = tmp_path / "twin" / "twin.json"
    twin.write_text(twin.read_text().replace(str(made / "tube"), str(tmp_path / "tube")))
    photo = tmp_path / "tube" / "0003_color.png"
    photo.write_bytes(photo.read_bytes()[:-100])
    assert "0003_color.png" in fails("fit", tmp_path / "twin", "--overwrite", "--budget", "3")


def test_a_sequence_with_no_valid_depth(fails, tube, tmp_path):
    for file in tube.glob("*_depth.tiff"):
        tifffile.imwrite(file, np.full((72, 96), 65535, np.uint16))
    assert "valid depth" in fails("fuse", tube, "-o", tmp_path / "twin")


def test_photos_that_are_all_clipped_give_a_warning_that_says_so(endotwin, tube, tmp_path):
    for file in tube.glob("*_color.png"):
        cv2.imwrite(str(file), np.full((72, 96, 3), 255, np.uint8))
    assert endotwin("fuse", tube, "-o", tmp_path / "twin")[0] == 0
    code, _, err = endotwin("fit", tmp_path / "twin", "--budget", 1)
    assert code == 0 and "unclipped" in err


def test_photos_that_are_all_black(fails, tube, tmp_path):
    for file in tube.glob("*_color.png"):
        cv2.imwrite(str(file), np.zeros((72, 96, 3), np.uint8))
    assert "black photos" in fails("fuse", tube, "-o", tmp_path / "twin")


def test_a_sequence_of_one_frame_says_that_none_is_left_to_score_by(endotwin, tmp_path):
    tube_sequence.write(tmp_path / "tube", 1)
    code, _, err = endotwin("fuse", tmp_path / "tube", "-o", tmp_path / "twin")
    assert code == 0 and "none is left to score the twin by" in err


def test_an_unknown_camera_model(fails, tube, tmp_path):
    (tube / "camera.json").write_text(json.dumps({"model": "periscope", "width": 96, "height": 72}))
    message = fails("fuse", tube, "-o", tmp_path / "twin")
    assert "periscope" in message and "pinhole" in message


# Bad input: twins, trajectories, outputs, options


def test_a_trajectory_outside_the_mesh(fails, made, tmp_path):
    poses = tube_sequence.poses(3)
    poses[1, 0, 3] = 500.0
    tube_sequence.write_poses(tmp_path / "pose.txt", poses)
    message = fails("synth", made / "twin", "--trajectory", tmp_path / "pose.txt", "-o", tmp_path / "dataset")
    assert "pose 1" in message


@pytest.mark.parametrize(
    "spec",
    ["nowhere.txt", "jitter:frames=many", "jitter:colour=3", "jitter:frames=10000000", "centerline:x=1"],
)
def test_a_trajectory_that_cannot_be_understood(fails, made, tmp_path, spec):
    message = fails("synth", made / "twin", "--trajectory", spec, "-o", tmp_path / "dataset")
    assert spec in message and len(message) < 350


@pytest.mark.parametrize(
    "command",
    [
        ["fuse", "{made}/tube", "-o", "{taken}"],
        ["fit", "{made}/twin", "-o", "{taken}"],
        ["eval", "{made}/twin", "--sheet", "{taken}.png"],
        ["synth", "{made}/twin", "--trajectory", "jitter:", "-o", "{taken}"],
        ["inspect", "{made}/twin", "--screenshot", "{taken}.png"],
    ],
    ids=lambda command: command[0],
)
def test_an_output_that_exists(fails, made, tmp_path, command):
    for name in ("taken", "taken.png"):
        (tmp_path / name).write_text("precious")
    message = fails(*[part.format(made=made, taken=tmp_path / "taken") for part in command])
    assert "taken" in message and "exists already" in message
    assert (tmp_path / "taken").read_text() == (tmp_path / "taken.png").read_text() == "precious"


def test_overwrite_replaces_a_twin_and_keeps_what_is_not_the_twins(endotwin, made, tmp_path):
    shutil.copytree(made / "twin", tmp_path / "twin")
    (tmp_path / "twin" / "notes").touch()
    code, _, err = endotwin("fuse", made / "tube", "-o", tmp_path / "twin", "--overwrite")
    assert code == 0, err
    names = sorted(entry.name.split("-")[0] for entry in (tmp_path / "twin").iterdir())
    assert names == ["notes", "surface", "twin.json"]


@pytest.mark.parametrize(
    ("command", "says"),
    [
        (["fuse", "tube", "-o", "tube"], "no twin.json"),
        (["fuse", "tube", "-o", "."], "no twin.json"),
        (["fuse", "tube", "-o", "photo.png"], "no twin.json"),
        (["fit", "twin", "-o", "tube"], "no twin.json"),
        (["synth", "twin", "--trajectory", "jitter:", "-o", "twin"], "no dataset.json"),
        (["synth", "dataset/twin", "--trajectory", "jitter:", "-o", "dataset"], "is read from it"),
        (["synth", "twin", "--trajectory", "dataset/pose.txt", "-o", "dataset"], "is read from it"),
        (["eval", "twin", "--sheet", "twin/twin.json"], ".png"),
        (["eval", "twin", "--sheet", "tube"], ".png"),
        (["eval", "twin", "--sheet", "folder.png"], "is a folder"),
        (["inspect", "twin", "--screenshot", "tube/camera.json"], ".png"),
    ],
    ids=lambda part: " ".join(part) if isinstance(part, list) else "",
)
def test_overwrite_destroys_no_input_and_nothing_that_endotwin_did_not_write(
    fails, made, tmp_path, monkeypatch, command, says
):
    for name in ("tube", "twin"):
        shutil.copytree(made / name, tmp_path / name)
    shutil.copytree(made / "twin", tmp_path / "dataset" / "twin")
    for name in ("dataset.json", "pose.txt"):
        (tmp_path / "dataset" / name).touch()
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "photo.png").write_text("precious")
    monkeypatch.chdir(tmp_path)
    assert says in fails(*command, "--overwrite")


@pytest.mark.parametrize("taken", ["twin/twin.json", "tube/camera.json", "tube/0000_color.png", "tube"])
def test_a_profile_replaces_nothing_but_a_profile(fails, made, tmp_path, monkeypatch, taken):
    for name in ("tube", "twin"):
        shutil.copytree(made / name, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    before = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    assert taken in fails("fuse", "tube", "-o", "new", "--profile", taken)
    assert {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()} == before


def test_a_profile_does_not_replace_what_the_same_command_wrote(endotwin, made, tmp_path):
    shutil.copytree(made / "twin", tmp_path / "twin")
    picture = tmp_path / "sheet.png"
    code, _, err = endotwin("eval", tmp_path / "twin", "--sheet", picture, "--profile", picture)
    assert code == 2 and "is no profile of endotwin's" in err
    assert cv2.imread(str(picture)) is not None


def test_aligned_poses_do_not_replace_those_of_the_sequence(fails, made, tube):
    before = (tube / "pose.txt").read_bytes()
    assert invoke("fuse", tube, "-o", tube.parent / "twin") == 0
    for name in ("pose.txt", "camera.json"):
        command = ("align", tube.parent / "twin", "--poses", tube / name, "--overwrite")
        assert "belongs to the sequence" in fails(*command)
    assert (tube / "pose.txt").read_bytes() == before


def test_undistorted_frames_are_those_that_a_twin_is_made_of(endotwin, tube, tmp_path):
    assert endotwin("fuse", tube, "-o", tmp_path / "twin", "--undistort", "48x36")[0] == 0
    document = json.loads((tmp_path / "twin" / "twin.json").read_text(encoding="utf-8"))
    assert (document["camera"]["width"], document["camera"]["height"]) == (48, 36)


def test_a_photo_of_another_size_truncated_or_none_stops_fuse_before_it_begins(fails, tube, tmp_path):
    folder = shutil.copytree(tube, tmp_path / "spoilt")
    photo = (folder / "0002_color.png").read_bytes()
    (folder / "0002_color.png").write_bytes(photo[:-20])
    assert "0002_color.png is truncated" in fails("fuse", folder, "-o", tmp_path / "twin")
    cv2.imwrite(str(folder / "0002_color.png"), np.full((10, 12, 3), 90, np.uint8))
    assert "0002_color.png is 12×10" in fails("fuse", folder, "-o", tmp_path / "twin")
    (folder / "0002_color.png").write_bytes(b"no picture")
    assert "0002_color.png" in fails("fuse", folder, "-o", tmp_path / "twin")


def test_frames_are_left_out_by_numbers_and_ranges(endotwin, tube, tmp_path):
    assert endotwin("fuse", tube, "-o", tmp_path / "twin", "--without", "1, 3-4")[0] == 0
    document = json.loads((tmp_path / "twin" / "twin.json").read_text(encoding="utf-8"))
    assert not {1, 3, 4} & {*document["source"]["split"]["training"]}


@pytest.mark.parametrize("frames", ("", "one", "4-2", "-1", "1,,2", "1-2-3"))
def test_frames_that_are_no_numbers_and_ranges_are_refused(fails, tube, tmp_path, frames):
    assert "write them as 12,17-19" in fails("fuse", tube, "-o", tmp_path / "twin", f"--without={frames}")


def test_a_file_of_a_sequence_is_no_folder_of_one(fails, tube, tmp_path):
    for name in ("pose.txt", "0000_color.png"):
        assert f"{name} is a file; name the folder" in fails("fuse", tube / name, "-o", tmp_path / "twin")


def test_a_sequence_that_is_taken_for_a_twin_is_not_proposed_as_the_place_of_one(fails, made):
    assert "'endotwin fuse SEQUENCE -o TWIN'" in fails("fit", made / "tube")


def test_what_ranges_are_read_from_must_be_there(fails, made, tmp_path):
    command = ("synth", made / "twin", "--trajectory", "jitter:frames=1", "-o", tmp_path / "data")
    assert "no.yaml cannot be read (No such file" in fails(*command, "--vary", tmp_path / "no.yaml")


def test_an_effect_that_is_named_twice_is_refused(fails, made, tmp_path):
    command = ("synth", made / "twin", "--trajectory", "jitter:frames=1", "-o", tmp_path / "data")
    assert "names noise twice" in fails(*command, "--effects", "noise=on,noise=off")


def test_a_profile_is_replaced_by_the_next(endotwin, made, tmp_path):
    shutil.copytree(made / "twin", tmp_path / "twin")
    for command in (["eval", tmp_path / "twin"], ["fuse", made / "tube", "-o", tmp_path / "new"]):
        code, _, err = endotwin(*command, "--profile", tmp_path / "profile.json")
        assert code == 0, err
        assert json.loads((tmp_path / "profile.json").read_text())["command"] == command[0]


@pytest.mark.slow
def test_a_twin_is_scored_and_fitted_from_where_one_stands_and_keeps_its_guests(
    endotwin, made, tmp_path, monkeypatch
):
    shutil.copytree(made / "twin", tmp_path / "twin")
    monkeypatch.chdir(tmp_path / "twin")
    for command in (["eval", ".", "--sheet", "sheet.png"], ["fit", ".", "--overwrite", "--budget", 1]):
        code, _, err = endotwin(*command, "--profile", "profile.json")
        assert code == 0, err
        assert {"sheet.png", "profile.json", "twin.json"} < set(os.listdir("."))
        assert len(list(Path(".").glob("materials-*"))) == 1


def test_names_of_effects_are_whole_on_a_narrow_terminal(endotwin, made, monkeypatch):
    from endotwin.effects import NAMES
    from endotwin.twin import Twin

    monkeypatch.setenv("COLUMNS", "80")
    code, out, _ = endotwin("effects", made / "twin")
    decided = Twin.load(made / "twin").decisions
    assert code == 0 and len(decided) > 5
    assert {line.split()[0] for line in out.splitlines() if line.split()} >= set(decided) & set(NAMES)
    assert max(map(len, out.splitlines())) <= 80


def test_no_label_is_no_choice_of_labels(fails, made, tmp_path):
    trajectory = ["--trajectory", "jitter:frames=1"]
    assert "no label ''" in fails(
        "synth", made / "twin", *trajectory, "--labels", "", "-o", tmp_path / "dataset"
    )


def test_the_scores_of_a_twin_that_was_replaced_meanwhile_are_not_kept(endotwin, made, tmp_path, monkeypatch):
    from endotwin import evaluation
    from endotwin.twin import Twin

    shutil.copytree(made / "twin", tmp_path / "twin")
    evaluate = evaluation.evaluate

    def overtaken(twin: Twin, *arguments):
        replace(twin, light=replace(twin.light, n=1.5)).save(tmp_path / "twin", overwrite=True)
        return evaluate(twin, *arguments)

    monkeypatch.setattr(evaluation, "evaluate", overtaken)
    code, out, err = endotwin("eval", tmp_path / "twin")
    assert code == 0 and "mean" in out and "was replaced while it was scored" in err
    kept = Twin.load(tmp_path / "twin")
    assert kept.light.n == 1.5 and "eval" not in kept.record


def test_the_scores_are_printed_even_if_they_cannot_be_kept(endotwin, made, tmp_path, monkeypatch):
    from endotwin.twin import Twin

    def save(self: Twin, path: Path, overwrite: bool) -> None:
        raise OSError(errno.EBUSY, "Device or resource busy", str(path))

    monkeypatch.setattr(Twin, "save", save)
    code, out, err = endotwin("eval", made / "twin")
    assert code == 2 and "mean" in out and err.count("\n") == 1


def test_a_fitted_twin_is_not_fitted_again_by_accident(fails, made):
    message = fails("fit", made / "twin")
    assert "--overwrite" in message and "fitted already" in message


@pytest.mark.parametrize("command", ["fit", "eval", "inspect"])
def test_a_twin_from_a_newer_version(fails, made, tmp_path, command):
    shutil.copytree(made / "twin", tmp_path / "twin")
    file = tmp_path / "twin" / "twin.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "version": 99}))
    message = fails(command, tmp_path / "twin")
    assert "99" in message and "update endotwin" in message


@pytest.mark.parametrize("command", ["fit", "eval", "inspect"])
def test_a_folder_that_is_no_twin(fails, made, command):
    assert "not a twin" in fails(command, made / "tube")


def test_an_export_without_a_known_suffix_lists_those_that_there_are(fails, made, tmp_path):
    assert all(
        suffix in fails("export", made / "twin", tmp_path / "colon.fbx") for suffix in (".glb", ".html")
    )
    assert "not a twin" in fails("export", made / "tube", tmp_path / "colon.ply")
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_twin(fails, made, tmp_path):
    shutil.copytree(made / "twin", tmp_path / "twin")
    (surface,) = (tmp_path / "twin").glob("surface-*")
    surface.write_bytes(surface.read_bytes()[:1000])
    assert "damaged" in fails("eval", tmp_path / "twin")


def test_an_unfitted_twin_has_no_scores_and_no_dataset(fails, endotwin, made, tmp_path):
    assert endotwin("fuse", made / "tube", "-o", tmp_path / "twin")[0] == 0
    assert "endotwin fit" in fails("eval", tmp_path / "twin")
    assert "endotwin fit" in fails(
        "synth", tmp_path / "twin", "--trajectory", "jitter:", "-o", tmp_path / "dataset"
    )


@pytest.mark.parametrize(
    "options",
    [
        ["fuse", "{made}/tube", "-o", "{new}", "--scale", "0"],
        ["fuse", "{made}/tube", "-o", "{new}", "--scale", "nan"],
        ["fuse", "{made}/tube", "-o", "{new}", "--scale", "20"],
        ["fuse", "{made}/tube", "-o", "{new}", "--scale", "abc"],
        ["fuse", "{made}/tube", "-o", "{new}", "--voxel", "1e9"],
        ["fuse", "{made}/tube", "-o", "{new}", "--voxel", "-1"],
        ["fuse", "{made}/tube", "-o", "{new}", "--geometry", "guessed"],
        ["fuse", "{made}/tube", "-o", "{new}", "--format", "betamax"],
        ["fit", "{made}/twin", "-o", "{new}", "--method", "magic"],
        ["fit", "{made}/twin", "-o", "{new}", "--budget", "0"],
        ["fit", "{made}/twin", "-o", "{new}", "--epochs", "0"],
        ["fit", "{made}/twin", "-o", "{new}", "--effects", "noise=on"],
        ["fit", "{made}/twin", "-o", "{new}", "--method", "endopbr", "--effects", "gain=off"],
        ["fit", "{made}/twin", "-o", "{new}", "--seed", "-1"],
        ["eval", "{made}/twin", "--scale", "1e9"],
        ["synth", "{made}/twin", "--trajectory", "jitter:", "-o", "{new}", "--material", "gloss*2"],
        ["synth", "{made}/twin", "--trajectory", "jitter:", "-o", "{new}", "--light", "intensity"],
        ["synth", "{made}/twin", "--trajectory", "jitter:", "-o", "{new}", "--light", "intensity=-5"],
        ["synth", "{made}/twin", "--trajectory", "jitter:", "-o", "{new}", "--seed", "-1"],
        ["inspect", "{made}/twin", "--screenshot", "{new}.png", "--map", "temperature"],
    ],
    ids=lambda options: " ".join(options[:1] + options[-2:]),
)
def test_an_option_whose_value_makes_no_sense(fails, made, tmp_path, options):
    fails(*[part.format(made=made, new=tmp_path / "new") for part in options])


@pytest.mark.parametrize(
    "command", [["fuse", "--outptu", "x"], ["fuse"], ["bake"], ["--bake"], ["fit", "twin", "--budget"]]
)
def test_a_mistyped_command_is_an_error_of_one_line_that_names_the_help(fails, command):
    assert "--help" in fails(*command)


def test_no_command_shows_the_help(endotwin):
    assert endotwin() == endotwin("--help")


def test_the_installed_command_reports_errors_without_a_traceback(tmp_path):
    command = Path(sys.executable).with_name("endotwin")
    done = subprocess.run(
        [command, "effects", tmp_path / "nothing"], capture_output=True, text=True, encoding="utf-8"
    )
    assert done.returncode == 2
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1

"""endotwin where the modules, signals and calls of POSIX are not there."""

import ast
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import tube_sequence
from command_line import in_one_child

SCRIPT = Path(__file__).with_name("windows.py")
ROOT = SCRIPT.parents[1]
POSIX_MODULES = {"fcntl", "resource", "termios", "tty", "pty", "pwd", "grp", "syslog"}


def endotwin(*arguments: object, **options) -> subprocess.CompletedProcess:
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, encoding="utf-8", check=False, **options)


def test_no_module_imports_what_windows_lacks_unless_it_is_ready_for_that():
    for folder in ("endotwin", "cli", "configs"):
        for file in (ROOT / folder).rglob("*.py"):
            tree = ast.parse(file.read_text(encoding="utf-8"))
            guarded = {
                id(inner) for node in ast.walk(tree) if isinstance(node, ast.Try) for inner in node.body
            }
            for node in ast.walk(tree):
                if isinstance(node, ast.Import | ast.ImportFrom) and id(node) not in guarded:
                    names = {alias.name for alias in node.names} | {getattr(node, "module", None)}
                    assert not POSIX_MODULES & names, file


@pytest.mark.long
def test_a_sequence_becomes_a_twin_and_a_dataset_without_posix(tmp_path):
    tube = tube_sequence.write(tmp_path / "tube", 6, 48, 36)
    (tmp_path / ".endotwin-left").mkdir()
    os.utime(tmp_path / ".endotwin-left", (0, 0))
    (tmp_path / ".endotwin-at-work").mkdir()
    twin, dataset = tmp_path / "twin", tmp_path / "dataset"
    done, codes = in_one_child(
        ["fuse", tube, "-o", twin],
        ["fit", twin, "--budget", "1"],
        ["eval", twin, "--sheet", tmp_path / "sheet.png"],
        ["synth", twin, "--trajectory", "jitter:frames=8", "-o", dataset],
        first="import windows\n",
        cwd=SCRIPT.parent,
    )
    assert codes == [0] * 4 and done.stderr.decode().count("peak memory") == 4
    anew = ("--trajectory", "jitter:frames=8", "--workers", 2, "-o", dataset, "--overwrite")
    done = endotwin("synth", twin, *anew, "--profile", tmp_path / "profile.json")
    assert (tmp_path / "profile.json").is_file()
    assert done.returncode == 0 and "peak memory" in done.stderr, done.stderr
    assert (dataset / "dataset.json").is_file() and not (tmp_path / "dataset.partial").exists()
    # without locks nobody can tell whose a hidden folder is, but by its age
    assert sorted(path.name for path in tmp_path.glob(".endotwin-*")) == [".endotwin-at-work"]


def test_every_command_starts_without_posix():
    commands = ("fuse", "fit", "eval", "synth", "inspect", "check", "tradeoff", "study")
    asked = ([command, "--help"] for command in commands)
    done, codes = in_one_child(*asked, first="import windows\n", cwd=SCRIPT.parent)
    assert codes == [0] * len(commands)
    assert all(f"endotwin {command} " in done.stdout.decode() for command in commands)


@pytest.mark.slow
def test_ctrl_c_stops_a_command_without_posix_timers(tmp_path):
    tube = tube_sequence.write(tmp_path / "tube", 6, 48, 36)
    for delay_s in (0.3, 0.8, 1.6):
        command = [
            sys.executable,
            str(SCRIPT),
            "fuse",
            str(tube),
            "-o",
            str(tmp_path / "twin"),
            "--voxel",
            "0.05",
        ]
        running = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, encoding="utf-8")
        time.sleep(delay_s)
        running.send_signal(signal.SIGINT)
        said = running.communicate(timeout=60)[1]
        assert running.returncode in (130, -signal.SIGINT), said  # the latter before it heeds anything
        assert not (tmp_path / "twin").exists()

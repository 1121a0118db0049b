"""Ctrl-C anywhere: exit code 130, one line, and no process is left."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
import tube_twin

pytestmark = pytest.mark.slow

PATIENT_S = 60

BEGUN = """
import os, signal, sys

class Interrupted:
    def find_spec(self, name, path, target=None):
        if name == {module!r}:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupted())
sys.argv = ["endotwin", "effects", "nowhere"]
from endotwin.cli.start import main
main()
"""

WAITING = """
import os, signal, sys
from endotwin.cli import main, start

def _workplace():
    os.kill(os.getpid(), signal.SIGINT)
    print("done", file=sys.stderr)

main.main = _workplace
start.main()
"""

BUSY = """
import hashlib, os, signal, sys
from threading import Timer
from endotwin.cli import effects, start
from endotwin.twin import Twin

def load(path):
    Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
    hashlib.pbkdf2_hmac("sha256", b"", b"", 2_000_000_000)

Twin.load = load
sys.argv = ["endotwin", "effects", "nowhere"]
start.main()
"""


TIDYING = """
import os, shutil, signal, sys
from endotwin.cli.stop import Stopped, heed_signals, tell
from endotwin.run import output

def rmtree(path, **options):
    os.kill(os.getpid(), signal.SIGINT)
    remove(path, **options)

remove, shutil.rmtree = shutil.rmtree, rmtree
heed_signals()
try:
    with output.whole_file(sys.argv[1]) as file:
        file.write_text("{}")
    signal.pause()
except Stopped as stopped:
    sys.exit(tell(stopped))
"""


def started(*command: object) -> subprocess.Popen:
    """A command in a group of its own, as a shell starts it."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "encoding": "utf-8"}
    return subprocess.Popen([sys.executable, *map(str, command)], start_new_session=True, **pipes)


def workers(process: subprocess.Popen, least: int) -> list[psutil.Process]:
    """Its children, once there are so many."""
    while process.poll() is None:
        children = psutil.Process(process.pid).children(recursive=True)
        if len(children) >= least:
            return children
        time.sleep(0.01)
    pytest.fail(process.communicate()[1])


def interrupt(process: subprocess.Popen) -> tuple[int, str]:
    """Ctrl-C, which reaches the whole group: exit code and what was said."""
    os.killpg(process.pid, signal.SIGINT)
    said = process.communicate(timeout=PATIENT_S)[1]
    return process.returncode, said


def test_selfcheck_stops_at_once_with_its_processes():
    process = started("-m", "endotwin.cli.start", "selfcheck")
    children = workers(process, 3)  # two that check, and Python's own tracker of resources
    code, said = interrupt(process)
    assert code == 130 and said == "stopped; nothing was written\n"
    assert not psutil.wait_procs(children, timeout=PATIENT_S)[1]


@pytest.mark.parametrize("shards", [0, pytest.param(1, marks=pytest.mark.long)])
def test_workers_that_render_say_nothing_and_what_is_done_is_kept(tmp_path, shards):
    tube_twin.fitted(tube_twin.seen(tube_twin.surface())).save(tmp_path / "twin")
    options = ["--trajectory", "centerline:frames=3000", "--workers", 2, "-o", tmp_path / "dataset"]
    process = started("-m", "endotwin.cli.start", "synth", tmp_path / "twin", *options)
    children = workers(process, 2)
    while process.poll() is None and len(list(tmp_path.glob("dataset.partial/done/*.json"))) < shards:
        time.sleep(0.01)
    code, said = interrupt(process)
    assert code == 130 and said.startswith("stopped; ") and said.count("\n") == 1
    assert not psutil.wait_procs(children, timeout=PATIENT_S)[1]
    assert (tmp_path / "dataset.partial").exists() == ("the same command goes on" in said)
    assert shards == 0 or "the same command goes on" in said


@pytest.mark.parametrize("module", ["endotwin.cli.main", "typer", "safetensors.numpy"])
def test_ctrl_c_while_a_command_is_still_being_imported_is_its_last_line(module):
    process = started("-c", BEGUN.format(module=module))
    said = process.communicate(timeout=PATIENT_S)[1]
    assert process.returncode == 130 and said.endswith(("stopped; nothing was written\n", "stopped\n"))


def test_ctrl_c_that_had_to_wait_until_the_command_ended_by_itself_is_heeded_still():
    process = started("-c", WAITING)
    said = process.communicate(timeout=PATIENT_S)[1]
    assert (process.returncode, said) == (130, "done\nstopped\n")


def test_ctrl_c_within_a_long_call_of_c_code_is_one_line():
    process = started("-c", BUSY)
    said = process.communicate(timeout=PATIENT_S)[1]
    assert (process.returncode, said) == (130, "stopped\n")


def test_ctrl_c_while_a_workplace_is_removed_leaves_nothing_behind(tmp_path):
    process = started("-c", TIDYING, tmp_path / "profile.json")
    said = process.communicate(timeout=PATIENT_S)[1]
    assert process.returncode == 130 and said.startswith("stopped")
    assert [path.name for path in tmp_path.iterdir()] == ["profile.json"]


def test_the_installed_command_begins_where_ctrl_c_is_heeded():
    script = Path(sys.executable).with_name("endotwin").read_text(encoding="utf-8")
    assert "from endotwin.cli.start import main" in script

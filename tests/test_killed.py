"""A kill at a change of a file, of every command that writes: old or new, and the next leaves no trace."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import tube_sequence
from command_line import in_one_process, invoke
from faults import Killed, killed
from test_full_disk import COMMANDS, contents

from endotwin import Twin

pytestmark = pytest.mark.slow

MOMENTS = 3
"""So many moments of each command are tried: the first, the last, and some between."""

OVER = {
    "align": ("aligned", "align twin -o aligned --poses poses.txt"),
    "align in place": ("twin", "align twin --overwrite"),
    "synth over a dataset": ("dataset", "synth twin --trajectory jitter:frames=2 -o dataset --overwrite"),
    "export over a file": ("old.glb", "export twin old.glb --overwrite"),
    "export over several": ("old.obj", "export twin old.obj --overwrite"),
    "export over a folder": ("old.mitsuba", "export twin old.mitsuba --overwrite"),
    "export of a package": ("new.usdz", "export twin new.usdz"),
    "export of a page": ("new.html", "export twin new.html"),
}
STUDY = "study depth --real tube --twin twin --test other --network small --frames 2 --steps 1"
TRADEOFF = "tradeoff tube --rungs draft+budget=0.1 --repeats 1"
LONG = {
    "tradeoff": ("new", f"{TRADEOFF} -o new"),
    "tradeoff over another": ("traded", f"{TRADEOFF} -o traded --overwrite"),
    "study": ("new", f"{STUDY} --seeds 1 -o new"),
    "study that goes on from another": ("studied", f"{STUDY} --seeds 2 -o studied --overwrite"),
}

ALL = {**COMMANDS, **OVER, **LONG}


@pytest.fixture(scope="module")
def begun(made, tmp_path_factory) -> Path:
    """What the commands begin with."""
    folder = tmp_path_factory.mktemp("begun")
    for name in ("tube", "twin"):
        shutil.copytree(made / name, folder / name)
    tube_sequence.write(folder / "other", 1, 40, 30)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for begin in (f"{TRADEOFF} -o traded", f"{STUDY} --seeds 1 -o studied"):
            assert invoke(*begin.split()) == 0
        assert invoke("synth", "twin", "--trajectory", "jitter:frames=3", "-o", "dataset") == 0
        for name in ("old.obj", "old.mitsuba"):
            assert invoke("export", "twin", name) == 0
    (folder / "old.glb").write_bytes(b"old")
    return folder


@pytest.fixture(scope="module", autouse=True)
def killed_with_what_it_runs():
    with pytest.MonkeyPatch.context() as patch:
        in_one_process(patch)
        yield


def run(folder: Path, begun: Path, command: str, after: int | None) -> tuple[list[str], int | None]:
    """The operations of a command in a fresh copy, and its exit code; None: it was killed."""
    for entry in folder.iterdir():
        shutil.rmtree(entry) if entry.is_dir() else entry.unlink()
    for entry in begun.iterdir():
        copy = shutil.copytree if entry.is_dir() else shutil.copy2
        copy(entry, folder / entry.name)
    with killed(folder, after) as done:
        try:
            return done, invoke(*command.split())
        except Killed:
            return done, None


def names(folder: Path) -> set[str]:
    """What lies in a folder, without the checksums of arrays: a twin that is fitted again is another."""
    found = (str(entry.relative_to(folder)) for entry in folder.rglob("*"))
    return {re.sub(r"-[0-9a-f]{16}\.", ".", name) for name in found}


def is_new(dataset: str) -> bool:
    """Whether its sheet tells of two frames."""
    return json.loads(Path(dataset, "dataset.json").read_text(encoding="utf-8"))["frames"] == 2


def moments(done: list[str], count: int) -> list[int]:
    """So many of the operations, evenly; of writes in a row only the first counts."""
    telling = [k for k, each in enumerate(done) if each != "write" or k == 0 or done[k - 1] != "write"]
    return [telling[k] for k in np.unique(np.linspace(0, len(telling) - 1, count).astype(int))]


@pytest.mark.parametrize(
    "name", [pytest.param(each, marks=[pytest.mark.long] * (each in {*LONG} - {"study"})) for each in ALL]
)
def test_a_command_that_is_killed_leaves_old_or_new_and_the_next_sweeps(begun, tmp_path, monkeypatch, name):
    if "usdz" in ALL[name][1]:
        pytest.importorskip("pxr")
    target, command = ALL[name]
    command = command.replace("read_only", "twin")
    monkeypatch.chdir(tmp_path)
    done, code = run(tmp_path, begun, command, None)
    assert code == 0 and done
    new = names(tmp_path)
    before = contents(begun)
    for after in moments(done, MOMENTS):
        _, code = run(tmp_path, begun, command, after)
        assert code is None or "budget" in command  # a second may hold less to write the next time
        Twin.load("twin")
        if (begun / target).is_file():
            assert Path(target).read_bytes() == before[begun / target] or len(Path(target).read_bytes()) > 9
        if target == "dataset":
            assert len(list(Path(target).glob("*_color.png"))) == (2 if is_new(target) else 3)
        if name in LONG and Path(target).exists():
            assert len(list(Path(target).glob("*.html"))) == 1
        again = command if "--overwrite" in command else f"{command} --overwrite"
        assert invoke(*again.split()) == 0
        assert names(tmp_path) == new

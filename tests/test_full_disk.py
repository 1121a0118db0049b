"""A full disk, met by every command that writes: one sentence with file and room, and all is as it was."""

import shutil
from pathlib import Path

import pytest
import tube_sequence
from command_line import invoke
from faults import full_disk

pytestmark = pytest.mark.slow

COMMANDS = {
    "fuse": ("new", "fuse tube -o new"),
    "fuse over a twin": ("twin", "fuse tube -o twin --overwrite"),
    "fit": ("new", "fit twin -o new --budget 0.1"),
    "fit in place": ("twin", "fit twin --overwrite --budget 0.1"),
    "eval": ("twin", "eval twin"),
    "eval with a picture": ("sheet.png", "eval twin --sheet sheet.png"),
    "eval with a profile": ("profile.json", "eval read_only --profile profile.json"),
    "synth": ("new", "synth twin --trajectory jitter:frames=2 -o new"),
    "synth of tars": ("new", "synth twin --trajectory jitter:frames=2 --layout webdataset -o new"),
    "synth of fluids": ("new", "synth twin --trajectory jitter:frames=2 --fluid blood:size=4 -o new"),
    "synth of polyps": ("new", "synth twin --trajectory jitter:frames=2 --polyp IIa:size=3 -o new"),
    "preview": ("new.png", "synth twin --trajectory jitter:frames=2 --preview new.png"),
    "inspect": ("new.png", "inspect twin --screenshot new.png --map base_color"),
    "export of one file": ("new.ply", "export twin new.ply"),
    "export of several": ("new", "export twin new.obj"),
    "export of a folder": ("new.mitsuba", "export twin new.mitsuba"),
    "tradeoff": ("new", "tradeoff tube -o new --rungs draft --repeats 1"),
    "study": ("new", "study depth --real tube --twin twin --test other -o new --network small"),
}


@pytest.fixture
def here(made, tmp_path, monkeypatch) -> Path:
    """A copy of them to stand in."""
    for name in ("tube", "twin"):
        shutil.copytree(made / name, tmp_path / name)
    tube_sequence.write(tmp_path / "other", 1, 40, 30)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def contents(folder: Path) -> dict[Path, bytes | None]:
    return {entry: entry.read_bytes() if entry.is_file() else None for entry in folder.rglob("*")}


@pytest.mark.parametrize("after", [0, 2])
@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_that_meets_a_full_disk_says_so_and_changes_nothing(here, capfd, monkeypatch, name, after):
    file, command = COMMANDS[name]
    if "read_only" in command:  # the scores have no place, so that the profile is the first to be written
        monkeypatch.setattr("endotwin.evaluation.keep_scores", lambda *_: False)
        command = command.replace("read_only", "twin")
    before = contents(here)
    with full_disk(here, after):
        code = invoke(*command.split())
    *_, said = capfd.readouterr().err.splitlines()
    assert code == 2
    assert (
        said.startswith("error: ") and f"{file}" in said and "the disk is full" in said and "MB free" in said
    )
    kept = here / "new.partial" if name in ("tradeoff", "study") else None  # whence the same command goes on
    assert {entry: content for entry, content in contents(here).items() if entry != kept} == before

"""Outputs appear whole or not at all."""

import errno
import os
import re
import shutil
import stat
from pathlib import Path

import pytest
from faults import full_disk, killed_at_every_operation

from endotwin.errors import OutputError
from endotwin.run.output import (
    check_apart,
    check_free,
    check_picture,
    copy_folder,
    goes_on,
    move_folder,
    whole_file,
    write_folder,
    write_folder_anew,
    write_with_parts,
)

OWN = re.compile("mark|[a-z]-[0-9]")


def write(path: Path, overwrite: bool = False, **files: str) -> None:
    """``write_folder`` of texts by name, ``_`` for ``-``."""
    contents = {name.replace("_", "-"): text.encode() for name, text in files.items()}
    write_folder(path, contents, "mark", OWN, overwrite)


def contents(folder: Path) -> dict[str, str]:
    """Every file below ``folder``, hidden ones too."""
    return {str(p.relative_to(folder)): p.read_text() for p in folder.rglob("*") if p.is_file()}


def test_a_folder_is_written_with_the_modes_that_the_umask_gives(tmp_path):
    before = os.umask(0o027)
    try:
        write(tmp_path / "out", mark="1", a_1="1")
        write(tmp_path / "out", overwrite=True, mark="2", a_2="2")
        with whole_file(tmp_path / "file") as file:
            file.write_text("1")
    finally:
        os.umask(before)
    modes = {entry.name: stat.S_IMODE(entry.stat().st_mode) for entry in tmp_path.rglob("*")}
    assert modes == {"out": 0o750, "mark": 0o640, "a-2": 0o640, "file": 0o640}


@pytest.mark.parametrize("error", (ValueError, KeyboardInterrupt))
def test_a_file_whose_block_raises_leaves_nothing(tmp_path, error):
    with pytest.raises(error), whole_file(tmp_path / "out.png") as file:
        file.write_text("1")
        raise error
    assert list(tmp_path.iterdir()) == []


def test_parents_made_for_a_block_that_raises_are_unmade_and_others_kept(tmp_path):
    (tmp_path / "mine").mkdir()
    with pytest.raises(ValueError), whole_file(tmp_path / "mine" / "a" / "b" / "out"):
        raise ValueError
    assert list(tmp_path.rglob("*")) == [tmp_path / "mine"]


@pytest.fixture
def made(tmp_path) -> Path:
    """A folder that was written before, with a file of the user's in it."""
    write(tmp_path / "out", mark="old", a_1="old", b_1="same")
    (tmp_path / "out" / "notes").write_text("mine")
    return tmp_path / "out"


def test_overwriting_replaces_what_was_written_before_and_keeps_what_was_not(made):
    same = (made / "b-1").stat()
    write(made, overwrite=True, mark="new", a_2="new", b_1="same")
    assert contents(made.parent) == {
        "out/mark": "new",
        "out/a-2": "new",
        "out/b-1": "same",
        "out/notes": "mine",
    }
    assert (made / "b-1").stat().st_ino == same.st_ino
    assert [p.name for p in made.parent.iterdir()] == ["out"]


def test_a_file_that_is_not_what_its_name_says_is_written_again(made):
    (made / "b-1").write_text("same"[::-1])
    write(made, overwrite=True, mark="new", b_1="same")
    assert contents(made) == {"mark": "new", "b-1": "same", "notes": "mine"}


def test_overwriting_the_folder_that_one_stands_in_leaves_one_there(made, monkeypatch):
    monkeypatch.chdir(made)
    write(Path("."), overwrite=True, mark="new")
    assert contents(Path(".")) == contents(made) == {"mark": "new", "notes": "mine"}


def test_a_folder_is_old_or_new_wherever_its_replacement_is_killed_and_the_next_leaves_no_trace(made):
    old, new = {"mark": "old", "a-1": "old"}, {"mark": "new", "a-2": "new", "c-1": "new"}
    seen = []

    def look() -> None:
        there = contents(made)
        mark = there["mark"]
        assert {**there, **(old if mark == "old" else new), "b-1": "same", "notes": "mine"} == there
        seen.append(mark)
        write(made, overwrite=True, mark="old", a_1="old", b_1="same")
        assert contents(made) == {**old, "b-1": "same", "notes": "mine"}

    def work() -> None:
        write(made, overwrite=True, mark="new", a_2="new", b_1="same", c_1="new")

    assert killed_at_every_operation(work, look) >= 15
    assert seen == sorted(seen, reverse=True) and set(seen) == {"old", "new"}
    assert [p.name for p in made.parent.iterdir()] == ["out"]


def test_a_new_folder_is_there_whole_or_not_at_all_wherever_its_writing_is_killed(tmp_path):
    def look() -> None:
        visible = {name for name in contents(tmp_path) if not name.startswith(".endotwin-")}
        assert visible in (set(), {"out/mark", "out/a-1"})
        write(tmp_path / "out", overwrite=True, mark="new", a_1="new")
        with whole_file(tmp_path / "other") as file:
            file.touch()
        assert contents(tmp_path) == {"out/mark": "new", "out/a-1": "new", "other": ""}
        assert {p.name for p in tmp_path.iterdir()} == {"out", "other"}
        for file in ("out/mark", "out/a-1", "other"):
            (tmp_path / file).unlink()
        (tmp_path / "out").rmdir()

    assert killed_at_every_operation(lambda: write(tmp_path / "out", mark="new", a_1="new"), look) >= 10


def test_a_file_is_old_or_new_wherever_its_replacement_is_killed(tmp_path):
    file = tmp_path / "file.txt"
    file.write_text("old")

    def work() -> None:
        with whole_file(file, overwrite=True) as beside:
            beside.write_text("new")

    def look() -> None:
        assert file.read_text() in ("old", "new")
        with whole_file(file, overwrite=True) as beside:
            beside.write_text("old")
        assert list(tmp_path.iterdir()) == [file]

    assert killed_at_every_operation(work, look) >= 5


def test_a_file_and_its_parts_are_old_or_new_wherever_their_replacement_is_killed(tmp_path):
    file = tmp_path / "file"
    (tmp_path / "p-9").write_text("another's")
    parts = {"old": {"p-1": "1", "q-1": "1"}, "new": {"p-2": "2", "q-1": "1", "r-1": "1"}}
    seen = []

    def write_all(text: str) -> None:
        named = {name: part.encode() for name, part in parts[text].items()}
        write_with_parts(file, text.encode(), named, re.compile("[pqr]-[1-8]"), overwrite=True)

    def look() -> None:
        there = contents(tmp_path)
        seen.append(there["file"])
        assert {**there, **parts[there["file"]]} == there
        write_all("old")
        assert contents(tmp_path) == {"file": "old", "p-9": "another's", **parts["old"]}

    write_all("old")
    assert killed_at_every_operation(lambda: write_all("new"), look) >= 15
    assert seen == sorted(seen, reverse=True) and set(seen) == {"old", "new"}
    assert {entry.name for entry in tmp_path.iterdir()} == {"file", "p-9", *parts["old"]}


def test_what_is_killed_in_a_folder_is_swept_by_whatever_is_written_there_next(made):
    def look() -> None:
        with whole_file(made / "other", overwrite=True) as file:
            file.write_text("2")
        assert not [entry for entry in made.iterdir() if entry.name.startswith(".")]
        write(made, overwrite=True, mark="old", a_1="old")

    killed_at_every_operation(lambda: write(made, overwrite=True, mark="new", a_2="new"), look)


@pytest.mark.parametrize("begins", [{}, {"mark": "old", "a-1": "old", "c-1": "old", "notes": "mine"}])
def test_a_folder_whose_names_change_their_content_is_old_or_new_wherever_it_is_killed(tmp_path, begins):
    out, new = tmp_path / "out", {"mark": "new", "a-1": "new"}
    mine = {name: text for name, text in begins.items() if name == "notes"}

    def begin() -> None:
        shutil.rmtree(out, ignore_errors=True)
        if begins:
            out.mkdir()
            write_texts(out, **begins)

    def work() -> None:
        named = {name: text.encode() for name, text in new.items()}
        write_folder_anew(out, named, "mark", OWN, overwrite=True)

    def look() -> None:
        there = {name: text for name, text in contents(out).items() if not name.startswith(".endotwin-")}
        assert there in (begins, {**new, **mine})
        work()
        assert contents(tmp_path) == {f"out/{name}": text for name, text in {**new, **mine}.items()}
        assert list(tmp_path.iterdir()) == [out]
        begin()

    begin()
    assert killed_at_every_operation(work, look) >= 10


def test_a_copy_of_a_folder_is_there_whole_or_not_at_all_wherever_its_making_is_killed(tmp_path):
    folder, copy = tmp_path / "one", tmp_path / "two"
    (folder / "in").mkdir(parents=True)
    write_texts(folder, a="1", b="2")
    write_texts(folder / "in", c="3")

    def look() -> None:
        assert not copy.exists() or contents(copy) == contents(folder)
        shutil.rmtree(copy, ignore_errors=True)
        copy_folder(folder, copy)
        assert contents(copy) == contents(folder) and set(tmp_path.iterdir()) == {folder, copy}
        shutil.rmtree(copy)

    assert killed_at_every_operation(lambda: copy_folder(folder, copy), look) >= 8


def test_work_that_goes_on_is_swept_of_what_was_being_written_when_it_was_killed(tmp_path):
    def look() -> None:
        assert goes_on(tmp_path, "mark", {"asked": 1}, "another")
        assert set(contents(tmp_path)) <= {"mark", "results/1"} and len(list(tmp_path.rglob("*/"))) == 1
        (tmp_path / "results" / "1").unlink(missing_ok=True)

    def work() -> None:
        with whole_file(tmp_path / "results" / "1") as file:
            file.write_text("1")

    write_texts(tmp_path, mark='{"asked": 1}', results_0="")
    (tmp_path / "results" / "0").unlink()
    assert killed_at_every_operation(work, look) >= 5


def test_what_a_living_run_is_writing_is_not_swept(tmp_path):
    with whole_file(tmp_path / "one") as first:
        first.write_text("1")
        with whole_file(tmp_path / "two") as second:
            second.write_text("2")
    assert contents(tmp_path) == {"one": "1", "two": "2"}


def test_a_full_disk_is_told_with_the_file_and_the_room_and_changes_nothing(made):
    (made.parent / "file").write_text("old")
    before = contents(made.parent)
    for after in range(6):
        told = pytest.raises(
            OutputError, match=r"out cannot be written: the disk is full \([0-9.]+ MB free\)"
        )
        with told, full_disk(made.parent, after):
            write(made, overwrite=True, mark="new", a_2="new")
        assert contents(made.parent) == before
    for after in range(4):
        told = pytest.raises(OutputError, match="file cannot be written: the disk is full")
        with told, full_disk(made.parent, after), whole_file(made.parent / "file", overwrite=True) as file:
            file.write_text("new")
        assert contents(made.parent) == before


def write_texts(folder: Path, **texts: str) -> None:
    for name, text in texts.items():
        file = folder / name.replace("_", "/")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)


@pytest.mark.parametrize("links", [True, False])
@pytest.mark.parametrize("swaps", [True, False])
def test_a_folder_takes_the_place_of_another_with_the_users_files_wherever_it_is_killed(
    tmp_path, monkeypatch, links, swaps
):
    def no_link(*_, **__) -> None:
        raise OSError(errno.EPERM, "this file system has no links")

    if not links:
        monkeypatch.setattr(os, "link", no_link)
    if not swaps:
        monkeypatch.setattr("endotwin.run.output.exchanged", lambda *_: False)
    new, out = tmp_path / "new", tmp_path / "out"
    guests = {"mine": "1", "notes/mine": "2"}

    def begin() -> None:
        shutil.rmtree(out, ignore_errors=True)
        write_texts(new, a="new", b="new")
        write_texts(out, a="old", c="old", mine="1", notes_mine="2")

    def work() -> None:
        move_folder(new, out, lambda name: str(name) in "abc")

    def look() -> None:
        there = contents(tmp_path)
        assert set(guests.values()) <= set(there.values())
        if swaps:
            visible = {name: text for name, text in contents(out).items() if ".endotwin" not in name}
            assert visible in ({"a": "old", "c": "old", **guests}, {"a": "new", "b": "new", **guests})
        if new.exists():
            work()
        assert contents(out) == {"a": "new", "b": "new", **guests}
        whole_of_another = tmp_path / "sweeps"
        with whole_file(whole_of_another) as file:
            file.touch()
        whole_of_another.unlink()
        assert list(tmp_path.iterdir()) == [out]
        begin()

    begin()
    assert killed_at_every_operation(work, look) >= 5


def test_a_users_file_that_would_be_lost_is_named(tmp_path):
    write_texts(tmp_path / "new", a="new", b="new")
    write_texts(tmp_path / "out", a="old", b="mine")
    with pytest.raises(OutputError, match="out/b is not endotwin's to replace"):
        move_folder(tmp_path / "new", tmp_path / "out", lambda name: str(name) == "a")
    assert contents(tmp_path / "out") == {"a": "old", "b": "mine"}


def test_a_folder_that_cannot_take_its_place_leaves_the_other_there(tmp_path):
    write_texts(tmp_path / "out", a="old")
    with pytest.raises(OSError):
        move_folder(tmp_path / "missing", tmp_path / "out", lambda name: True)
    assert contents(tmp_path) == {"out/a": "old"}


def test_a_failed_overwrite_keeps_what_was_there(made, tmp_path):
    (tmp_path / "file").write_text("old")
    before = contents(tmp_path)
    with pytest.raises(ValueError), whole_file(tmp_path / "file", overwrite=True) as file:
        file.write_text("new")
        raise ValueError
    assert contents(tmp_path) == before


def test_what_endotwin_did_not_write_is_never_overwritten(tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "0000_color.png").write_text("precious")
    (tmp_path / "file").write_text("precious")
    before = contents(tmp_path)
    for name in ("photos", "file"):
        with pytest.raises(OutputError, match=f"{name} exists already.*no mark"):
            check_free(tmp_path / name, overwrite=True, mark="mark")
        with pytest.raises(OutputError):
            write(tmp_path / name, overwrite=True, mark="new")
    assert contents(tmp_path) == before


def test_an_empty_folder_may_be_overwritten(tmp_path):
    (tmp_path / "out").mkdir()
    write(tmp_path / "out", overwrite=True, mark="new")
    assert contents(tmp_path) == {"out/mark": "new"}


def test_a_link_to_a_file_stays_a_link_and_what_it_names_is_replaced(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    file, link = tmp_path / "elsewhere" / "file", tmp_path / "link"
    link.symlink_to(file)
    for text in ("1", "2"):
        with whole_file(link, overwrite=True) as beside:
            beside.write_text(text)
        assert link.is_symlink() and file.read_text() == text
    write_with_parts(link, b"3", {"p-3": b"3"}, re.compile("p-[0-9]"), overwrite=True)
    assert link.is_symlink() and contents(tmp_path / "elsewhere") == {"file": "3", "p-3": "3"}


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such files")
def test_a_device_or_pipe_is_never_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for place in (tmp_path / "pipe", Path("/dev/null")):
        with pytest.raises(OutputError, match="is a device or pipe"):
            check_free(place, overwrite=True)


def test_a_folder_is_no_place_for_a_file(tmp_path):
    with pytest.raises(OutputError, match="is a folder"):
        check_free(tmp_path, overwrite=True)


def test_a_picture_must_be_named_as_one(tmp_path):
    for name in ("twin.json", "sheet.jpg", "sheet"):
        with pytest.raises(OutputError, match=r"let it end in \.png"):
            check_picture(tmp_path / name, overwrite=True)
    check_picture(tmp_path / "sheet.PNG", overwrite=False)


def test_an_output_that_holds_an_input_is_refused(made):
    for source in (made, str(made / "notes"), made / ".." / "out" / "a-1"):
        with pytest.raises(OutputError, match="is read from it"):
            check_apart(made, [None, "jitter:frames=3", source])
    check_apart(made, [None, "jitter:frames=3", "a" * 300, made.parent, made / "nothing"])
    check_apart(made / "new", [made])


def test_overwriting_replaces_a_file_once_the_block_has_ended(tmp_path):
    (tmp_path / "out.png").write_text("old")
    with whole_file(tmp_path / "out.png", overwrite=True) as file:
        file.write_text("new")
        assert file.suffix == ".png"
        assert (tmp_path / "out.png").read_text() == "old"
    assert contents(tmp_path) == {"out.png": "new"}


def test_an_output_that_exists_is_refused_untouched(tmp_path):
    (tmp_path / "out").write_text("old")
    with pytest.raises(OutputError, match=r"out exists already.*--overwrite"), whole_file(tmp_path / "out"):
        pytest.fail("the block must not be entered")
    assert contents(tmp_path) == {"out": "old"}


def test_parents_are_made(tmp_path):
    write(tmp_path / "a" / "b", mark="1")
    with whole_file(tmp_path / "c" / "d.txt") as file:
        file.write_text("2")
    assert contents(tmp_path) == {"a/b/mark": "1", "c/d.txt": "2"}


def test_a_path_below_a_file_is_refused(tmp_path):
    (tmp_path / "file").write_text("old")
    with pytest.raises(OutputError, match="cannot be written"):
        check_free(tmp_path / "file" / "out", overwrite=True)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_refused(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(OutputError, match="may write to"):
        check_free(tmp_path / "out", overwrite=False)

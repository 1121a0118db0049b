"""Outputs appear whole or not at all."""

import os
from pathlib import Path

import pytest

from endotwin.errors import OutputError
from endotwin.run.output import check_apart, check_free, check_picture, whole_file, whole_folder

FILES = ("mark", "a", "old")


def contents(folder: Path) -> dict[str, str]:
    """Every file below ``folder``, hidden ones too."""
    return {str(p.relative_to(folder)): p.read_text() for p in folder.rglob("*") if p.is_file()}


def test_a_folder_appears_only_when_its_block_has_ended(tmp_path):
    with whole_folder(tmp_path / "out", FILES) as folder:
        (folder / "a").write_text("1")
        assert not (tmp_path / "out").exists()
    assert contents(tmp_path) == {"out/a": "1"}
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("error", (ValueError, KeyboardInterrupt))
def test_a_folder_whose_block_raises_leaves_nothing(tmp_path, error):
    with pytest.raises(error), whole_folder(tmp_path / "out", FILES) as folder:
        (folder / "a").write_text("1")
        raise error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("error", (ValueError, KeyboardInterrupt))
def test_a_file_whose_block_raises_leaves_nothing(tmp_path, error):
    with pytest.raises(error), whole_file(tmp_path / "out.png") as file:
        file.write_text("1")
        raise error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("whole", (lambda path: whole_folder(path, FILES), whole_file))
def test_parents_made_for_a_block_that_raises_are_unmade_and_others_kept(tmp_path, whole):
    (tmp_path / "mine").mkdir()
    with pytest.raises(ValueError), whole(tmp_path / "mine" / "a" / "b" / "out"):
        raise ValueError
    assert list(tmp_path.rglob("*")) == [tmp_path / "mine"]


@pytest.fixture
def made(tmp_path) -> Path:
    """A folder that was written before, with a file of the user's in it."""
    with whole_folder(tmp_path / "out", FILES) as folder:
        for name in ("mark", "old"):
            (folder / name).write_text("old")
    (tmp_path / "out" / "notes").write_text("mine")
    return tmp_path / "out"


def test_overwriting_replaces_what_was_written_before_and_keeps_what_was_not(made):
    with whole_folder(made, FILES, overwrite=True) as folder:
        (folder / "mark").write_text("new")
        (folder / "a").write_text("new")
        assert contents(made) == {"mark": "old", "old": "old", "notes": "mine"}
    assert contents(made.parent) == {"out/mark": "new", "out/a": "new", "out/notes": "mine"}
    assert [p.name for p in made.parent.iterdir()] == ["out"]


def test_overwriting_the_folder_that_one_stands_in_leaves_one_there(made, monkeypatch):
    monkeypatch.chdir(made)
    with whole_folder(Path("."), FILES, overwrite=True) as folder:
        (folder / "mark").write_text("new")
    assert contents(Path(".")) == contents(made) == {"mark": "new", "notes": "mine"}


@pytest.mark.parametrize("moves", range(4))
def test_an_overwrite_that_is_stopped_while_files_are_moved_leaves_all_as_it_was(made, monkeypatch, moves):
    rename, left = Path.rename, [moves]

    def stopped(self: Path, target: Path) -> Path:
        left[0] -= 1
        if left[0] == -1:
            raise KeyboardInterrupt
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", stopped)
    with pytest.raises(KeyboardInterrupt), whole_folder(made, FILES, overwrite=True) as folder:
        for name in ("mark", "a"):
            (folder / name).write_text("new")
    assert contents(made.parent) == {"out/mark": "old", "out/old": "old", "out/notes": "mine"}
    assert [p.name for p in made.parent.iterdir()] == ["out"]


def test_a_failed_overwrite_keeps_what_was_there(made, tmp_path):
    (tmp_path / "file").write_text("old")
    before = contents(tmp_path)
    with pytest.raises(ValueError), whole_folder(made, FILES, overwrite=True) as folder:
        (folder / "new").write_text("new")
        raise ValueError
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
        with pytest.raises(OutputError), whole_folder(tmp_path / name, FILES, overwrite=True):
            pytest.fail("the block must not be entered")
    assert contents(tmp_path) == before


def test_an_empty_folder_may_be_overwritten(tmp_path):
    (tmp_path / "out").mkdir()
    with whole_folder(tmp_path / "out", FILES, overwrite=True) as folder:
        (folder / "mark").write_text("new")
    assert contents(tmp_path) == {"out/mark": "new"}


def test_a_folder_is_no_place_for_a_file(tmp_path):
    with pytest.raises(OutputError, match="is a folder"):
        check_free(tmp_path, overwrite=True)


def test_a_picture_must_be_named_as_one(tmp_path):
    for name in ("twin.json", "sheet.jpg", "sheet"):
        with pytest.raises(OutputError, match=r"let it end in \.png"):
            check_picture(tmp_path / name, overwrite=True)
    check_picture(tmp_path / "sheet.PNG", overwrite=False)


def test_an_output_that_holds_an_input_is_refused(made):
    for source in (made, str(made / "notes"), made / ".." / "out" / "old"):
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
    with whole_folder(tmp_path / "a" / "b", FILES) as folder:
        (folder / "x").write_text("1")
    with whole_file(tmp_path / "c" / "d.txt") as file:
        file.write_text("2")
    assert contents(tmp_path) == {"a/b/x": "1", "c/d.txt": "2"}


def test_a_path_below_a_file_is_refused(tmp_path):
    (tmp_path / "file").write_text("old")
    with pytest.raises(OutputError, match="cannot be written"):
        check_free(tmp_path / "file" / "out", overwrite=True)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_refused(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(OutputError, match="may write to"):
        check_free(tmp_path / "out", overwrite=False)

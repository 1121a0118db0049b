"""Outputs appear whole or not at all."""

import os
from pathlib import Path

import pytest

from endotwin.errors import OutputError
from endotwin.output import check_free, whole_file, whole_folder


def contents(folder: Path) -> dict[str, str]:
    """Every file below ``folder``, hidden ones too."""
    return {str(p.relative_to(folder)): p.read_text() for p in folder.rglob("*") if p.is_file()}


def test_a_folder_appears_only_when_its_block_has_ended(tmp_path):
    with whole_folder(tmp_path / "out") as folder:
        (folder / "a").write_text("1")
        assert not (tmp_path / "out").exists()
    assert contents(tmp_path) == {"out/a": "1"}
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("error", (ValueError, KeyboardInterrupt))
def test_a_folder_whose_block_raises_leaves_nothing(tmp_path, error):
    with pytest.raises(error), whole_folder(tmp_path / "out") as folder:
        (folder / "a").write_text("1")
        raise error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("error", (ValueError, KeyboardInterrupt))
def test_a_file_whose_block_raises_leaves_nothing(tmp_path, error):
    with pytest.raises(error), whole_file(tmp_path / "out.png") as file:
        file.write_text("1")
        raise error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("whole", (whole_folder, whole_file))
def test_parents_made_for_a_block_that_raises_are_unmade_and_others_kept(tmp_path, whole):
    (tmp_path / "mine").mkdir()
    with pytest.raises(ValueError), whole(tmp_path / "mine" / "a" / "b" / "out"):
        raise ValueError
    assert list(tmp_path.rglob("*")) == [tmp_path / "mine"]


def test_overwriting_replaces_all_of_a_folder_and_keeps_it_until_then(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "old").write_text("old")
    with whole_folder(tmp_path / "out", overwrite=True) as folder:
        (folder / "new").write_text("new")
        assert contents(tmp_path / "out") == {"old": "old"}
    assert contents(tmp_path) == {"out/new": "new"}
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_overwriting_a_file_by_a_folder_leaves_the_folder_alone(tmp_path):
    (tmp_path / "out").write_text("old")
    with whole_folder(tmp_path / "out", overwrite=True) as folder:
        (folder / "new").write_text("new")
    assert contents(tmp_path) == {"out/new": "new"}


def test_a_failed_overwrite_keeps_what_was_there(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "old").write_text("old")
    (tmp_path / "file").write_text("old")
    with pytest.raises(ValueError), whole_folder(tmp_path / "out", overwrite=True) as folder:
        (folder / "new").write_text("new")
        raise ValueError
    with pytest.raises(ValueError), whole_file(tmp_path / "file", overwrite=True) as file:
        file.write_text("new")
        raise ValueError
    assert contents(tmp_path) == {"out/old": "old", "file": "old"}


def test_overwriting_replaces_a_file_once_the_block_has_ended(tmp_path):
    (tmp_path / "out.png").write_text("old")
    with whole_file(tmp_path / "out.png", overwrite=True) as file:
        file.write_text("new")
        assert file.suffix == ".png"
        assert (tmp_path / "out.png").read_text() == "old"
    assert contents(tmp_path) == {"out.png": "new"}


def test_an_output_that_exists_is_refused_untouched(tmp_path):
    (tmp_path / "out").write_text("old")
    for whole in (whole_folder, whole_file):
        with pytest.raises(OutputError, match=r"out exists already.*--overwrite"), whole(tmp_path / "out"):
            pytest.fail("the block must not be entered")
    assert contents(tmp_path) == {"out": "old"}


def test_parents_are_made(tmp_path):
    with whole_folder(tmp_path / "a" / "b") as folder:
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

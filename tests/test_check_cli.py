"""``endotwin check`` on the command line: exit codes, table and JSON."""

import json
import shutil

import pytest
from command_line import invoke
from damaged import DAMAGES, Copy

pytestmark = pytest.mark.slow


def test_exit_code_0_and_a_table_where_all_agrees(example, capsys):
    assert invoke("check", example) == 0
    out = capsys.readouterr().out
    assert "agree" in out and "principal point" in out


def test_exit_code_1_and_what_to_change_where_something_is_wrong(example, tmp_path, capsys):
    copy = Copy(example)
    DAMAGES["poses transposed"].do(copy)
    folder = copy.write(tmp_path / "copy")
    assert invoke("check", folder, "--json") == 1
    (finding,) = json.loads(capsys.readouterr().out)["findings"]
    assert finding["kind"] == "poses_transposed" and finding["file"] == "pose.txt"
    assert "Transpose" in finding["change"]


@pytest.mark.parametrize("name", ["nowhere", "empty", "without poses"])
def test_exit_code_2_and_one_line_where_there_is_nothing_to_read(example, tmp_path, capsys, name):
    (tmp_path / "empty").mkdir()
    shutil.copytree(example, tmp_path / "without poses")
    (tmp_path / "without poses" / "pose.txt").write_text("")
    assert invoke("check", tmp_path / name) == 2
    error = capsys.readouterr().err
    assert error.startswith("error:") and error.count("\n") == 1 and name in error

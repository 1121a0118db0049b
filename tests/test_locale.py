"""Any locale, and names that are not UTF-8: commands print and write what they should."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import invoke

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("command", "says"),
    [
        ("eval twin", "gamma 0."),
        ("effects twin", "specular"),
        ("check tube", "+-"),
        ("synth twin --trajectory jitter:frames=2 -o dataset", "wrote dataset"),
    ],
)
def test_commands_spell_out_what_the_terminal_lacks_and_write_utf_8(made, command, says):
    plain = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    arguments = [sys.executable, "-X", "warn_default_encoding", "-W", "error::EncodingWarning:endotwin"]
    done = subprocess.run(
        [*arguments, "-m", "endotwin.cli.start", *command.split()], cwd=made, env=plain, capture_output=True
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.isascii() and says in done.stdout.decode()
    assert done.stderr.isascii() and b"Traceback" not in done.stderr
    if command.startswith("synth"):
        assert "turned by up to 10°" in (made / "dataset" / "dataset.json").read_text(encoding="utf-8")


def test_a_sequence_whose_name_is_not_utf_8_becomes_a_twin_and_a_dataset(made, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = os.fsdecode(b"k\xf6lon")
    (made / "tube").rename(folder)
    try:
        assert invoke("fuse", folder, "-o", "twin") == 0
        assert invoke("fit", "twin", "--budget", 1) == 0
        assert invoke("synth", "twin", "--trajectory", f"{folder}/pose.txt", "-o", "dataset") == 0
        assert invoke("check", folder) in (0, 1)
    finally:
        Path(folder).rename(made / "tube")
    document = json.loads(Path("dataset/dataset.json").read_text(encoding="utf-8"))
    assert document["twin"]["sequence"] == folder

"""Any locale, and names that are not UTF-8: commands print and write what they should."""

import json
import os
import shutil
import subprocess
import sys

import pytest

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


def test_a_sequence_whose_name_is_not_utf_8_becomes_a_twin_and_a_dataset(made, tmp_path):
    folder = os.fsdecode(b"k\xf6lon")
    shutil.copytree(made / "tube", tmp_path / folder)

    def run(*command: str) -> int:
        """In a process of its own: pytest's workers cannot pass on what is not UTF-8."""
        arguments = [sys.executable, "-m", "endotwin.cli.start", *command]
        return subprocess.run(arguments, cwd=tmp_path, capture_output=True).returncode

    assert run("fuse", folder, "-o", "twin") == 0
    assert run("fit", "twin", "--budget", "1") == 0
    assert run("synth", "twin", "--trajectory", f"{folder}/pose.txt", "-o", "dataset") == 0
    assert run("check", folder) in (0, 1)
    document = json.loads((tmp_path / "dataset" / "dataset.json").read_text(encoding="utf-8"))
    assert document["twin"]["sequence"] == folder

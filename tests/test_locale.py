"""Any locale, and names that are not UTF-8: commands print and write what they should."""

import json
import os
import shutil

import pytest
from command_line import in_one_child

pytestmark = pytest.mark.slow


def test_commands_spell_out_what_the_terminal_lacks_and_write_utf_8(made):
    plain = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done, codes = in_one_child(
        ["eval", "twin"],
        ["effects", "twin"],
        ["check", "tube"],
        ["synth", "twin", "--trajectory", "jitter:frames=2", "-o", "dataset"],
        python=("-X", "warn_default_encoding", "-W", "error::EncodingWarning:endotwin"),
        cwd=made,
        env=plain,
    )
    assert codes == [0] * 4
    assert done.stdout.isascii() and done.stderr.isascii() and b"Traceback" not in done.stderr
    said = done.stdout.decode().split("\x1e")
    for text, says in zip(said, ("gamma 0.", "specular", "+-", "wrote dataset"), strict=False):
        assert says in text
    assert "turned by up to 10°" in (made / "dataset" / "dataset.json").read_text(encoding="utf-8")


@pytest.mark.long
def test_a_sequence_whose_name_is_not_utf_8_becomes_a_twin_and_a_dataset(made, tmp_path):
    folder = os.fsdecode(b"k\xf6lon")
    shutil.copytree(made / "tube", tmp_path / folder)

    _, codes = in_one_child(  # pytest's workers cannot pass on what is not UTF-8
        ["fuse", folder, "-o", "twin"],
        ["fit", "twin", "--budget", "0.1"],
        ["synth", "twin", "--trajectory", f"{folder}/pose.txt", "-o", "dataset"],
        ["check", folder],
        cwd=tmp_path,
    )
    assert codes[:3] == [0] * 3 and codes[3] in (0, 1)
    document = json.loads((tmp_path / "dataset" / "dataset.json").read_text(encoding="utf-8"))
    assert document["twin"]["sequence"] == folder

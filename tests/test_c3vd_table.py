"""The table of benchmarks/c3vd.py: what is there, what is not, what others published, and going on."""

import csv
import json
import subprocess
import sys
from pathlib import Path

import pytest
import tube_sequence

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "c3vd.py"


def table(root: Path, work: Path, *options: str) -> tuple[list[dict], str]:
    """The rows of the CSV, and what was printed."""
    command = [sys.executable, str(SCRIPT), str(root), "--work", str(work), "--config", "draft", *options]
    done = subprocess.run(command, capture_output=True, text=True, encoding="utf-8", check=True)
    (file,) = work.glob("*.csv")
    with file.open(encoding="utf-8", newline="") as opened:
        return list(csv.DictReader(opened)), done.stdout


@pytest.mark.long
def test_the_table_has_every_sequence_the_published_rows_and_goes_on_where_it_was(tmp_path):
    root, work = tmp_path / "download", tmp_path / "work"
    tube_sequence.write(root / "registered" / "cecum_t1_a", 9, 96, 72)
    broken = tube_sequence.write(root / "registered" / "trans_t1_a", 4, 96, 72)
    (broken / "0001_depth.tiff").write_bytes(b"nothing")
    rows, printed = table(root, work, "--protocol", "coliags")
    by_name = {row["sequence"]: row for row in rows}
    assert sum(row["note"] == f"not in {root}" for row in rows) == 20
    scored = by_name["cecum_t1_a"]
    kept = json.loads((work / "coliags-draft" / "cecum_t1_a" / "row.json").read_text())
    assert scored["PSNR"] == f"{kept['psnr']:.2f}" and scored["frames"] == "9" and scored["fuse"]
    assert "0001_depth.tiff" in by_name["trans_t1_a"]["note"]
    assert by_name["endotwin, mean"]["PSNR"] == scored["PSNR"]
    assert (by_name["ColIAGS"]["PSNR"], by_name["ColIAGS"]["LPIPS"]) == ("36.30", "0.150")
    assert "AlexNet" in printed and "| ColIAGS |" in printed
    assert "<td>ColIAGS</td>" in next(work.glob("*.html")).read_text(encoding="utf-8")

    kept["psnr"] = 12.34  # what was kept is not made again
    (work / "coliags-draft" / "cecum_t1_a" / "row.json").write_text(json.dumps(kept))
    rows, _ = table(root, work, "--protocol", "coliags", "--sequences", "cecum_t1_a", "cecum_t1_b")
    assert [row["PSNR"] for row in rows[:3]] == ["12.34", "", "12.34"]
    (tmp_path / "download").rename(tmp_path / "other")
    rows, _ = table(tmp_path / "other", work, "--protocol", "coliags", "--sequences", "cecum_t1_a")
    assert "name another with --work" in rows[0]["note"]

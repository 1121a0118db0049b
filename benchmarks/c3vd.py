"""The C3VD table: every registered sequence found below ROOT, beside the numbers that others published.

    python benchmarks/c3vd.py ROOT
    python benchmarks/c3vd.py ROOT --protocol coliags --sequences cecum_t1_a trans_t2_b

ROOT is a download of C3VD (version 1 or 2), or any folder of sequences in its layout. Each sequence is fused,
aligned where endotwin can, fitted and scored on every 8th frame, in processes of their own. What is done lies
below --work and is not done again, so that a run that was stopped goes on. The table is printed, and written
as CSV and HTML.
"""

from __future__ import annotations

import argparse
import csv
import html
import json
import math
import subprocess
import sys
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

from endotwin.errors import EndotwinError, OutputError
from endotwin.run.output import whole_file
from endotwin.sequence.readers import c3vd

SEGMENTS = {
    "cecum": ("t1_a", "t1_b", "t2_a", "t2_b", "t2_c", "t3_a", "t4_a", "t4_b"),
    "desc": ("t4_a",),
    "sigmoid": ("t1_a", "t2_a", "t3_a", "t3_b"),
    "trans": ("t1_a", "t1_b", "t2_a", "t2_b", "t2_c", "t3_a", "t3_b", "t4_a", "t4_b"),
}
REGISTERED = [f"{segment}_{name}" for segment, names in SEGMENTS.items() for name in names]
"""The 22 sequences of version 1 that are registered to a model (Bobrow et al. 2023)."""

TEN = ["cecum_t1_b", "cecum_t2_b", "cecum_t3_a", "sigmoid_t1_a", "sigmoid_t2_a", "sigmoid_t3_a"]
TEN += ["trans_t1_b", "trans_t2_c", "trans_t4_a", "trans_t4_b"]

LPIPS = "LPIPS: AlexNet, VGG: VGG-16; images in [-1, 1], ignored pixels black in both; published: of either"


@dataclass(frozen=True)
class Protocol:
    """How a published table was made.

    Attributes:
        says: in words. options: of ``endotwin fuse``. published: PSNR, SSIM and LPIPS by method. source: of
            these.
        sequences: those that it has; None: all.
    """

    says: str
    options: tuple[str, ...] = ()
    published: dict[str, tuple[float, float, float]] | None = None
    source: str = ""
    sequences: list[str] | None = None


PROTOCOLS = {
    "native": Protocol("as photographed, every 8th frame held out"),
    "endopbr": Protocol(
        "undistorted to 640×480, every 8th frame held out",
        ("--undistort", "640x480"),
        {
            "NeRF": (18.93, 0.67, 0.43),
            "REIM-NeRF": (31.66, 0.78, 0.22),
            "Gaussian Pancakes": (32.31, 0.90, 0.20),
            "EndoPBR": (30.39, 0.86, 0.30),
        },
        "Han & Wu, EndoPBR (WACV 2026); EndoPBR on three sequences",
    ),
    "coliags": Protocol(
        "338×270, every 8th frame held out",
        ("--scale", "0.25"),
        {
            "REIM-NeRF": (33.96, 0.86, 0.32),
            "2DGS": (32.93, 0.88, 0.24),
            "Gaussian Pancakes": (32.93, 0.88, 0.24),
            "3DGS": (34.10, 0.89, 0.22),
            "Scaffold-GS": (34.26, 0.89, 0.21),
            "PR-ENDO": (34.15, 0.89, 0.23),
            "ColIAGS": (36.30, 0.91, 0.15),
        },
        "ColIAGS",
    ),
    "ten": Protocol("the ten scenes of EndoGSLAM and PR-ENDO, as photographed", sequences=TEN),
}

SCORES = (
    ("PSNR", "psnr", 2),
    ("SSIM", "ssim", 3),
    ("LPIPS", "lpips", 3),
    ("LPIPS VGG", "lpips_vgg", 3),
    ("PSNR covered", "psnr_covered", 2),
    ("PSNR dull", "psnr_dull", 2),
    ("recall", "recall", 2),
    ("precision", "precision", 2),
    ("covered", "covered", 4),
)
"""Columns of scores, their names in a row, and their digits; dull is what is off highlights, which recall and
precision are of."""

COLUMNS = ("sequence", "frames", "fused", "fuse", "align", "fit", "memory")
COLUMNS += (*(column for column, _, _ in SCORES), "note")


def found(root: Path) -> dict[str, Path]:
    """Folders in C3VD's layout at most three levels below ``root``, by name in lower case."""
    places = [root, *root.glob("*"), *root.glob("*/*"), *root.glob("*/*/*")]
    return {place.resolve().name.lower(): place for place in places if (place / c3vd.MARK).is_file()}


def endotwin(*arguments: object) -> subprocess.CompletedProcess:
    """One command, in a process of its own."""
    command = [sys.executable, "-m", "endotwin.cli.start", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, encoding="utf-8")


def score(folder: Path, options: tuple[str, ...], work: Path) -> dict:
    """What a sequence gave: the scores and the cost of each step, or the error that ended it.

    Steps that an earlier run has done are not done again; raises OutputError if that was of something else.
    """
    twin, kept, note = work / "twin", work / "row.json", work / "asked.json"
    asked = json.dumps([str(folder.resolve()), *options])
    if note.exists() and note.read_text(encoding="utf-8") != asked:
        raise OutputError(f"{work} holds what another folder or other options gave; name another with --work")
    work.mkdir(parents=True, exist_ok=True)
    note.write_text(asked, encoding="utf-8")
    if kept.exists():
        return json.loads(kept.read_text(encoding="utf-8"))
    steps = {"fuse": ("fuse", folder, "-o", twin, *options), "align": ("align", twin), "fit": ("fit", twin)}
    if endotwin("align", "--help").returncode:
        del steps["align"]  # of a version that has it not
    row = {"frames": len(c3vd.read(folder))}
    for name, arguments in steps.items():
        profile = work / f"{name}.json"
        if not profile.exists():
            done = endotwin(*arguments, "--overwrite", "--profile", profile)
            if done.returncode:
                return {**row, "note": f"{name}: {done.stderr.strip().splitlines()[-1]}"}
        row[name] = json.loads(profile.read_text(encoding="utf-8"))
    done = endotwin("eval", twin, "--json", "--sheet", work / "sheet.png", "--overwrite")
    if done.returncode:
        return {**row, "note": f"eval: {done.stderr.strip().splitlines()[-1]}"}
    scores = json.loads(done.stdout)
    if scores["lpips"] is not None:
        vgg = endotwin("eval", twin, "--json", "--lpips", "vgg")
        row["lpips_vgg"] = None if vgg.returncode else json.loads(vgg.stdout)["lpips"]
    record = json.loads((twin / "twin.json").read_text(encoding="utf-8"))["record"]["fuse"]
    row |= {"fused": len(record["fused"]), **{name: scores[name] for _, name, _ in SCORES if name in scores}}
    with whole_file(kept) as file:
        file.write_text(json.dumps(row, indent=1) + "\n", encoding="utf-8")
    return row


def cells(name: str, row: dict) -> dict[str, str]:
    """A row of the table, as text."""
    told = {"sequence": name, "note": row.get("note", "")}
    for key in ("frames", "fused"):
        told[key] = str(row.get(key, ""))
    for key in ("fuse", "align", "fit"):
        told[key] = f"{row[key]['seconds']:.0f} s" if key in row else ""
    peaks = [row[key]["peak_memory_mb"] for key in ("fuse", "align", "fit") if key in row]
    told["memory"] = f"{max(peaks) / 1000:.1f} GB" if peaks else ""
    for column, key, digits in SCORES:
        told[column] = shown(row.get(key), digits)
    return {column: told.get(column, "") for column in COLUMNS}


def shown(value: float | None, digits: int) -> str:
    return "" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def mean(rows: list[dict]) -> dict:
    """The mean of the scores of all ``rows`` that have them."""
    scored = [row for row in rows if row.get("psnr") is not None]
    values = {name: [row[name] for row in scored if row.get(name) is not None] for _, name, _ in SCORES}
    return {name: sum(found) / len(found) for name, found in values.items() if found}


def table(rows: dict[str, dict], protocol: Protocol) -> list[dict[str, str]]:
    """All lines of the table: sequences, their mean, and what was published."""
    lines = [cells(name, row) for name, row in rows.items()]
    count = sum(row.get("psnr") is not None for row in rows.values())
    lines.append(cells("endotwin, mean", {**mean(list(rows.values())), "note": f"of {count} sequences"}))
    for method, (psnr, ssim, lpips) in (protocol.published or {}).items():
        published = {"psnr": psnr, "ssim": ssim, "lpips": lpips, "note": f"published: {protocol.source}"}
        lines.append(cells(method, published))
    return lines


def as_markdown(lines: list[dict[str, str]]) -> str:
    rows = [COLUMNS, tuple("---" for _ in COLUMNS), *(tuple(line.values()) for line in lines)]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def as_html(lines: list[dict[str, str]], title: str, remark: str) -> str:
    def row(tag: str, values) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(value)}</{tag}>" for value in values) + "</tr>"

    body = "\n".join([row("th", COLUMNS), *(row("td", line.values()) for line in lines)])
    style = (
        "body{font-family:sans-serif}td,th{padding:.2em .6em;text-align:left;border-bottom:1px solid #ccc}"
    )
    head = f'<!doctype html><meta charset="utf-8"><title>{html.escape(title)}</title><style>{style}</style>'
    return f"{head}<h1>{html.escape(title)}</h1><table>\n{body}\n</table><p>{html.escape(remark)}</p>\n"


def write(lines: list[dict[str, str]], title: str, base: Path) -> None:
    """The table as ``base``.csv and ``base``.html."""
    text = StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    with whole_file(base.with_suffix(".csv"), overwrite=True) as file:
        file.write_text(text.getvalue(), encoding="utf-8")
    with whole_file(base.with_suffix(".html"), overwrite=True) as file:
        file.write_text(as_html(lines, title, LPIPS), encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("root", type=Path)
    parser.add_argument(
        "--sequences", nargs="+", help="by name; all 22 and whatever else is there, unless given"
    )
    parser.add_argument("--protocol", choices=PROTOCOLS, default="native")
    parser.add_argument("--config", default="standard")
    parser.add_argument("--work", type=Path, default=Path("c3vd"), help="where twins and tables are kept")
    options = parser.parse_args()
    if not options.root.is_dir():
        sys.exit(f"error: {options.root} is no folder; name that of the C3VD download")
    protocol, there = PROTOCOLS[options.protocol], found(options.root)
    names = options.sequences or protocol.sequences or [*REGISTERED, *sorted(set(there) - set(REGISTERED))]
    rows = {}
    for name in names:
        if name.lower() not in there:
            rows[name] = {"note": f"not in {options.root}"}
            continue
        try:
            place = options.work / f"{options.protocol}-{Path(options.config).stem}" / name
            rows[name] = score(there[name.lower()], (*protocol.options, "--config", options.config), place)
        except EndotwinError as error:
            rows[name] = {"note": " ".join(str(error).split())}
        print(f"{name}: {rows[name].get('psnr') or rows[name].get('note')}", file=sys.stderr, flush=True)
    lines, title = table(rows, protocol), f"C3VD, {protocol.says}"
    options.work.mkdir(parents=True, exist_ok=True)
    write(lines, title, options.work / f"c3vd-{options.protocol}-{Path(options.config).stem}")
    print(title, as_markdown(lines), LPIPS, sep="\n\n")


if __name__ == "__main__":
    main()

"""The run: every rung as often as asked, each result kept as soon as it is there."""

from __future__ import annotations

import csv
import json
import os
import platform
import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np

from endotwin.config import to_yaml
from endotwin.errors import OutputError
from endotwin.output import TRADEOFF, check_free
from endotwin.readers import open_sequence
from endotwin.sequence import Sequence
from endotwin.tradeoff import crops, plot, report
from endotwin.tradeoff.ladder import Rung
from endotwin.tradeoff.measure import SCORES, keep, measured
from endotwin.twin import Source

Progress = Callable[[str, int, int], None]

PARTIAL = ".partial"


def tradeoff(
    path: Path,
    out: Path,
    rungs: list[Rung],
    repeats: int = 3,
    geometry: str = "known",
    overwrite: bool = False,
    progress: Progress | None = None,
) -> list[dict]:
    """Measure ``rungs`` on the sequence at ``path`` and write table, plot and page to the folder ``out``.

    Until all is measured the results lie in ``out.partial``; the same call goes on from there. Repeats go
    round the ladder, so that a machine that is busy for a while slows all rungs alike; each has a seed of its
    own.

    Returns:
        one row a rung, as ``summary`` makes them.

    Raises:
        SequenceError: no such sequence. OutputError: ``out`` is taken, or ``out.partial`` is another
        sequence's. RungError: a command failed; what was measured before stays in ``out.partial``.
    """
    check_free(out, overwrite, TRADEOFF)
    sequence = open_sequence(path)
    sequence.require_valid_depth()
    work = out.with_name(out.name + PARTIAL)
    _enter(work, {"sequence": str(path.resolve()), "geometry": geometry})
    patch = crops.telling_patch(sequence, Source(str(path), sequence.format))
    runs = [(repeat, rung) for repeat in range(repeats) for rung in rungs]
    try:
        for done, (repeat, rung) in enumerate(runs):
            if progress:
                progress(f"{rung.name}, run {repeat + 1} of {repeats}", done, len(runs))
            _measure(rung, repeat, sequence, geometry, work, patch)
    except BaseException as stopped:
        stopped.add_note(f"the same command goes on from {work}")
        raise
    if progress:
        progress("report", len(runs), len(runs))
    rows = [summary(rung, repeats, work, out, path, geometry) for rung in rungs]
    crops.save(crops.photo(sequence, patch), work / "crops" / "photo.png")
    size = f"{sequence.camera.width}×{sequence.camera.height}"
    facts = {
        "sequence": f"{len(sequence)} frames at {size} through a {sequence.camera.model} camera",
        "name": path.name,
        "geometry": geometry,
        "repeats": repeats,
        "machine": machine(),
        "patch": f"frame {sequence.color_files[patch.frame].name}, {patch.size}×{patch.size} pixels "
        f"at column {patch.column}, row {patch.row}",
    }
    _write_csv(rows, work / "tradeoff.csv")
    plot.draw(rows, [work / "tradeoff.png", work / "tradeoff.svg"])
    report.write(rows, facts, work)
    for name in ("twin", "profile.json"):
        entry = work / name
        shutil.rmtree(entry) if entry.is_dir() else entry.unlink(missing_ok=True)
    if out.exists():
        shutil.rmtree(out)
    work.rename(out)
    return rows


def _enter(work: Path, asked: dict) -> None:
    """Make the working folder, or go on in it if it was made for the same sequence and geometry."""
    question = work / TRADEOFF
    if question.exists():
        if json.loads(question.read_text()) != asked:
            raise OutputError(
                f"{work} holds the results of another sequence or geometry; delete it or choose another -o"
            )
        return
    for folder in ("rungs", "results", "crops"):
        (work / folder).mkdir(parents=True, exist_ok=True)
    keep(asked, question)


def _measure(
    rung: Rung, repeat: int, sequence: Sequence, geometry: str, work: Path, patch: crops.Patch
) -> None:
    """Measure one run of a rung and keep it, unless that was done; the first one's crop is kept too."""
    result = work / "results" / f"{rung.name}.{repeat}.json"
    asked = {"config": asdict(rung.config)}
    if result.exists() and json.loads(result.read_text()).items() >= asked.items():
        return
    file = work / "rungs" / f"{rung.name}.yaml"
    file.write_text(to_yaml(rung.config))
    commands = rung.commands(sequence.path.resolve(), rung.given or str(file.resolve()), geometry, repeat)
    measurement = measured(commands, [*sequence.color_files, *sequence.depth_files], work.resolve())
    if repeat == 0:
        crops.save(crops.render(work / "twin", patch), work / "crops" / f"{rung.name}.png")
    keep({**asked, **measurement}, result)


def summary(rung: Rung, repeats: int, work: Path, out: Path, path: Path, geometry: str) -> dict:
    """One rung's row: medians over the repeats, and the range of what varies.

    Returns:
        ``{"rung", "knob", "seconds", "seconds_min", "seconds_max", scores..., "psnr_min", "psnr_max",
        "peak_memory_mb", "load", "stages": {name: s}, "commands": [str]}``; a score nobody measured is NaN.
    """
    runs = [
        json.loads((work / "results" / f"{rung.name}.{repeat}.json").read_text()) for repeat in range(repeats)
    ]
    values = {
        name: np.array([np.nan if run[name] is None else run[name] for run in runs], float)
        for name in ("seconds", *SCORES, "peak_memory_mb", "load")
    }
    row = {"rung": rung.name, "knob": rung.knob, "repeats": repeats}
    row |= {name: float(np.median(value)) for name, value in values.items()}
    for name in ("seconds", "psnr", "ssim"):
        row |= {f"{name}_min": float(values[name].min()), f"{name}_max": float(values[name].max())}
    middle = runs[int(np.argsort(values["seconds"])[len(runs) // 2])]
    config = rung.given or str(out / "rungs" / f"{rung.name}.yaml")
    commands = rung.commands(path, config, geometry)
    return {**row, "stages": middle["stages"], "commands": commands}


def machine() -> str:
    """What it was measured on, in words."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        model = lines[0].split(":", 1)[1].strip() if lines else model
    return f"{os.cpu_count()} cores, {model}, {platform.system()}"


def _write_csv(rows: list[dict], path: Path) -> None:
    """One line a rung; the stages' seconds in columns of their own."""
    stages = list(dict.fromkeys(name for row in rows for name in row["stages"]))
    plain = [name for name in rows[0] if name not in ("stages", "commands")]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([*plain, *(f"{name} s" for name in stages), "commands"])
        for row in rows:
            values = [f"{row[name]:.6g}" if isinstance(row[name], float) else row[name] for name in plain]
            shares = [f"{row['stages'].get(name, 0):.3f}" for name in stages]
            writer.writerow([*values, *shares, report.one_line(row["commands"])])

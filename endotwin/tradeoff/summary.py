"""Runs of a rung as one row: medians, ranges, and the commands; rows as a CSV file."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np

from endotwin.tradeoff.ladder import Rung, one_line
from endotwin.tradeoff.measure import SCORES


def summary(
    rung: Rung, repeats: int, work: Path, out: Path, path: Path, geometry: str, beside: tuple[str, ...] = ()
) -> dict:
    """One rung's row: medians over the repeats, and the range of what varies.

    Args:
        beside: more numbers of a result to take the median of.

    Returns:
        ``{"rung", "knob", "seconds", "seconds_min", "seconds_max", scores..., "psnr_min", "psnr_max",
        "peak_memory_mb", "load", "stages": {name: s}, "commands": [str]}``; a score nobody measured is NaN.
    """
    runs = [
        json.loads((work / "results" / f"{rung.name}.{repeat}.json").read_text(encoding="utf-8"))
        for repeat in range(repeats)
    ]
    values = {
        name: np.array([np.nan if run[name] is None else run[name] for run in runs], float)
        for name in ("seconds", *SCORES, "peak_memory_mb", "load", *beside)
    }
    row = {"rung": rung.name, "knob": rung.knob, "repeats": repeats}
    row |= {name: float(np.median(value)) for name, value in values.items()}
    for name in ("seconds", "psnr", "ssim"):
        row |= {f"{name}_min": float(values[name].min()), f"{name}_max": float(values[name].max())}
    middle = runs[int(np.argsort(values["seconds"])[len(runs) // 2])]
    config = rung.given or str(out / "rungs" / f"{rung.name}.yaml")
    commands = rung.commands(path, config, geometry)
    return {**row, "stages": middle["stages"], "commands": commands}


def write_csv(rows: list[dict], path: Path) -> None:
    """One line a row, in the order of the fullest; stages in columns of their own, what a row lacks empty."""
    stages = list(dict.fromkeys(name for row in rows for name in row.get("stages", ())))
    columns = dict.fromkeys(name for row in sorted(rows, key=len, reverse=True) for name in row)
    plain = [name for name in columns if name not in ("stages", "commands")]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([*plain, *(f"{name} s" for name in stages), "commands"])
        for row in rows:
            values = [row.get(name, "") for name in plain]
            values = [f"{value:.6g}" if isinstance(value, float) else value for value in values]
            spent = row.get("stages")
            shares = ["" if spent is None else f"{spent.get(name, 0):.3f}" for name in stages]
            writer.writerow([*values, *shares, one_line(row.get("commands", []))])

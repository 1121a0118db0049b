"""The main job on the bundled example: fuse → fit → eval → synth → inspect, each as a user would type it.

python examples/demo.py [SEQUENCE] [-o demo]
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

from rich.console import Console
from rich.table import Table

EXAMPLE = Path(__file__).parent / "colon_small"
FIT_BUDGET_S = 120


def endotwin(*arguments: object, profile: Path, capture: bool = False) -> str:
    """Run one command, show it, and return what it printed on stdout if ``capture``."""
    words = [str(argument) for argument in arguments]
    print("\n$ endotwin", *words, flush=True)
    command = [sys.executable, "-m", "endotwin.cli.main", *words, "--profile", str(profile)]
    done = subprocess.run(command, stdout=subprocess.PIPE if capture else None, text=True, encoding="utf-8")
    if done.returncode:
        sys.exit(done.returncode)
    return done.stdout or ""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequence", nargs="?", type=Path, default=EXAMPLE)
    parser.add_argument("-o", "--output", type=Path, default=Path("demo"))
    options = parser.parse_args()
    demo, twin = options.output, options.output / "twin"
    demo.mkdir(parents=True, exist_ok=True)
    profiles = {name: demo / f"{name}.json" for name in ("fuse", "fit", "eval", "synth", "inspect")}
    sheet, dataset, picture = demo / "sheet.png", demo / "dataset", demo / "twin.png"

    endotwin("fuse", options.sequence, "-o", twin, "--overwrite", profile=profiles["fuse"])
    endotwin("fit", twin, "--budget", FIT_BUDGET_S, profile=profiles["fit"])
    scores = endotwin(
        "eval", twin, "--json", "--sheet", sheet, "--overwrite", profile=profiles["eval"], capture=True
    )
    trajectory = [
        "--trajectory",
        "jitter:frames=24",
        "--material",
        "roughness*1.3",
        "--light",
        "intensity*0.8",
    ]
    endotwin("synth", twin, *trajectory, "-o", dataset, "--overwrite", profile=profiles["synth"])
    endotwin("inspect", twin, "--screenshot", picture, "--overwrite", profile=profiles["inspect"])
    report(profiles, json.loads(scores))
    print(f"twin       {twin}\ndataset    {dataset}")
    print(f"pictures   {sheet} (photo, render, error), {picture} (the mesh)")


def report(profiles: dict[str, Path], scores: dict) -> None:
    """Print what each stage cost and how well the held-out photos were predicted."""
    table = Table(title="endotwin on the bundled example")
    for column in ("stage", "seconds", "peak memory"):
        table.add_column(column, justify="left" if column == "stage" else "right")
    costs = {name: json.loads(path.read_text()) for name, path in profiles.items()}
    for name, cost in costs.items():
        table.add_row(name, f"{cost['seconds']:.1f}", f"{cost['peak_memory_mb'] / 1000:.2f} GB")
    total = sum(cost["seconds"] for cost in costs.values())
    peak = max(cost["peak_memory_mb"] for cost in costs.values())
    table.add_row("all", f"{total:.1f}", f"{peak / 1000:.2f} GB", end_section=True)
    Console().print(table)
    print(f"held-out photos: PSNR {scores['psnr']:.2f} dB, SSIM {scores['ssim']:.4f} over all valid pixels;")
    print(
        f"PSNR {scores['psnr_covered']:.2f} dB over the {scores['covered']:.1%} that a training photo saw\n"
    )


if __name__ == "__main__":
    main()

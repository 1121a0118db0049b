"""Does endotwin find what scenes with everything at once have? Those of path_tracer.py, judged one by one.

    python benchmarks/path_traced.py scenes/*

Each is fused, fitted and scored in a process of its own. Columns: errors of γ and of the exponents n and q;
mean distance of the guides from the true ones; PSNR of the whole and the covered part of held-out photos;
seconds; what the scene has, and effects that were missed (−) or are not there (+). No guides (-): light at
the lens, or another number of them.
"""

import argparse
import json
import math
import multiprocessing
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

sys.path.append(str(Path(__file__).parent))

from decisions import EFFECTS, fitted

ANGULAR = ("profile", "vignetting")
"""Say the same of a light at the lens, and are not counted there unless light bounces."""


def row(folder: Path) -> str:
    """A line of the table."""
    made = json.loads((folder / "truth" / "made.json").read_text(encoding="utf-8"))
    fit, true = fitted(folder, made, None), made["effects"]
    told = [name for name in EFFECTS if name not in ANGULAR or {"offset", "interreflection"} & {*true}]
    wrong = [f"−{name}" for name in told if name in true and name not in fit.on]
    wrong += [f"+{name}" for name in told if name in fit.on and name not in true]
    has = [*true, *(["registered"] if made["registered"] else [])]
    cells = [folder.name, *(f"{error:+.1f} %" for error in (fit.gamma, fit.n, fit.q))]
    cells += ["-" if math.isnan(fit.guides_mm) else f"{fit.guides_mm:.2f} mm"]
    cells += [f"{fit.whole_db:.2f} dB", f"{fit.covered_db:.2f} dB"]
    return " | ".join([*cells, f"{fit.seconds:.0f} s", ", ".join(has) or "none", ", ".join(wrong) or "right"])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", type=Path, nargs="+", help="folders that path_tracer.py made")
    titles = ("scene", "γ", "n", "q", "guides", "PSNR", "covered", "time", "has", "decided")
    scenes = parser.parse_args().scenes
    print("| " + " | ".join(titles) + " |\n" + "|---" * len(titles) + "|", flush=True)
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn, max_tasks_per_child=1) as pool:
        for scene in scenes:
            print(f"| {pool.submit(row, scene).result()} |", flush=True)


if __name__ == "__main__":
    main()

"""Does endotwin find the effects that a scene has? Random scenes of an independent renderer, judged one by
one.

    python benchmarks/decisions.py --seeds 0..39 --work scenes -o decisions.csv
    python benchmarks/decisions.py --seeds 3,7,12 --only interreflection,gain --forced

A scene is made once and kept in the folder --work. Each is fused, fitted and scored in a process of its own,
and its row is printed at once; at the end come, of each effect, how often it was rightly and wrongly found,
and the evidence of the wrong decisions. ``--forced`` fits scenes with a wrong decision once more with the
true effects, which tells what it cost.

The column (3 %) tells how well the photos know γ: levels of 255 that an error of 3 % shows, all else fitted
as well as it can be. The smaller, the more does a small fault of the model bend γ.

Not counted is what no photo tells: an effect that changes the photos by less than 1/255 (root mean square)
after the best fit of the rest (see ``independent.shown``); and vignetting and profile, which say the same of
a light at the lens, wherever there is vignetting with such a light or one of the two is too faint.
"""

import argparse
import csv
import json
import multiprocessing
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field
from itertools import permutations
from pathlib import Path

import numpy as np

import endotwin

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from independent.scene import EFFECTS, Scene
from independent.shown import LEAST_LEVELS
from independent.write import make

HEADER = "seed     γ %  (3 %)    n %    q %  guides  whole cover  time  true → wrong"


@dataclass(frozen=True)
class Fit:
    """What a fit decided, and how good it is.

    Attributes:
        on: effects. reasons: the recorded evidence of each. gamma, n, q: errors in percent. guides_mm: mean
            distance from the true guides, NaN where their number is wrong or the light at the lens.
    """

    on: list[str]
    reasons: dict[str, str]
    gamma: float
    n: float
    q: float
    guides_mm: float
    whole_db: float
    covered_db: float
    seconds: float


@dataclass(frozen=True)
class Row:
    """One scene.

    Attributes:
        true: effects. levels: of 255 that each shows. wrong_levels: those that 3 % of error in γ, n or q
            show, all else fitted as well as it can be. uncounted: effects that these photos cannot tell.
        fit: as decided. forced: with the true effects. wrong: effects that were decided wrongly.
    """

    seed: int
    true: list[str]
    levels: dict[str, float]
    wrong_levels: dict[str, float]
    uncounted: list[str]
    fit: Fit
    forced: Fit | None = None
    wrong: list[str] = field(default_factory=list)


def judged(seed: int, only: list[str], work: Path, forced: bool) -> Row:
    """Make the scene if need be, fit it and compare."""
    folder = work / f"{seed:04d}" / ("all" if set(only) == set(EFFECTS) else "+".join(sorted(only)) or "none")
    made = make(Scene.draw(seed, only), folder)
    true, levels = made["effects"], {name: shown["levels"] for name, shown in made["shown"].items()}
    fit = fitted(folder, made, None)
    skipped = uncounted(true, levels)
    wrong = [name for name in EFFECTS if name not in skipped and (name in fit.on) != (name in true)]
    again = fitted(folder, made, states(true, skipped)) if forced and wrong else None
    return Row(seed, true, levels, made["wrong_levels"], skipped, fit, again, wrong)


def uncounted(true: list[str], levels: dict[str, float]) -> list[str]:
    """Effects of which this scene's photos cannot tell whether they are there."""
    faint = {name for name in true if levels[name] < LEAST_LEVELS}
    angular = {"profile", "vignetting"}
    if faint & angular or ("vignetting" in true and not {"offset", "interreflection"} & set(true)):
        faint |= angular
    if "offset" in faint:
        faint.add("shadows")
    return sorted(faint)


def states(true: list[str], skipped: list[str]) -> dict[str, str]:
    """The true states of effects, as a fit can be told; it may decide those that cannot be told."""
    return {name: "on" if name in true else "off" for name in EFFECTS if name not in skipped}


def fitted(folder: Path, made: dict, effects: dict[str, str] | None) -> Fit:
    """Fuse, fit and score the sequence in ``folder``."""
    began = time.perf_counter()
    twin = endotwin.fit_twin(endotwin.fuse_twin(folder), effects=effects)
    scores = endotwin.evaluate(twin)
    decisions = twin.decisions
    guides_mm = twin.effects.guides_mm
    return Fit(
        on=[name for name in EFFECTS if decisions[name].state == "on"],
        reasons={name: decisions[name].reason for name in EFFECTS},
        gamma=100 * (twin.response.gamma / made["gamma"] - 1),
        n=100 * (twin.light.n / made["n"] - 1),
        q=100 * (twin.light.q / made["q"] - 1),
        guides_mm=apart_mm(guides_mm, made["guides_mm"]) if "offset" in made["effects"] else float("nan"),
        whole_db=scores.psnr,
        covered_db=scores.psnr_covered,
        seconds=time.perf_counter() - began,
    )


def apart_mm(found_mm: object, true_mm: object) -> float:
    """Mean distance of guides from the true ones, paired as fits best; NaN if there are more or fewer."""
    if found_mm is None or len(found_mm) != len(true_mm):
        return float("nan")
    true_mm = np.asarray(true_mm)
    orders = permutations(np.asarray(found_mm))
    return float(min(np.linalg.norm(np.stack(order) - true_mm, axis=1).mean() for order in orders))


def line(row: Row) -> str:
    """The row as text; wrong decisions as +false and −missed, those not counted in brackets."""
    fit = row.fit
    true = " ".join(f"({name})" if name in row.uncounted else name for name in row.true) or "none"
    wrong = " ".join(f"+{name}" if name in fit.on else f"−{name}" for name in row.wrong) or "right"
    text = (
        f"{row.seed:4d}  {fit.gamma:+6.1f} {row.wrong_levels['gamma']:6.2f} {fit.n:+6.1f} {fit.q:+6.1f} "
        f"{fit.guides_mm:7.2f}  {fit.whole_db:5.2f} {fit.covered_db:5.2f} {fit.seconds:4.0f}s  "
        f"{true} → {wrong}"
    )
    if row.forced is None:
        return text
    forced = row.forced
    gained_db = forced.covered_db - fit.covered_db
    return f"{text}\n      true effects forced: {gained_db:+.2f} dB, γ {forced.gamma:+.1f} %"


def confusion(rows: list[Row]) -> str:
    """Of each effect: how often it was found where it is, missed, claimed where it is not, rightly left
    out."""
    lines = [
        f"{'effect':16} {'found':>6} {'missed':>6} {'false':>6} {'absent':>6} {'right':>7} {'uncounted':>10}"
    ]
    sums = np.zeros(4, int)
    for name in EFFECTS:
        counted = [row for row in rows if name not in row.uncounted]
        cells = np.zeros(4, int)
        for row in counted:
            there, on = name in row.true, name in row.fit.on
            cells[(0 if on else 1) if there else (2 if on else 3)] += 1
        sums += cells
        lines.append(_confusion_line(name, cells, len(rows) - len(counted)))
    lines.append(_confusion_line("all", sums, len(rows) * len(EFFECTS) - int(sums.sum())))
    right = sum(not row.wrong for row in rows)
    return "\n".join([*lines, f"{right} of {len(rows)} scenes are right in everything that counts"])


def _confusion_line(name: str, cells: np.ndarray, uncounted: int) -> str:
    found, missed, false, absent = map(int, cells)
    share = 100 * (found + absent) / max(cells.sum(), 1)
    return f"{name:16} {found:6d} {missed:6d} {false:6d} {absent:6d} {share:5.1f} % {uncounted:10d}"


def evidence(rows: list[Row]) -> str:
    """The wrong decisions with what they were taken on."""
    told = []
    for row in rows:
        for name in row.wrong:
            what = f"shows {row.levels[name]:.1f} levels" if name in row.true else "is not there"
            told.append(f"seed {row.seed}: {name} {what}; '{row.fit.reasons[name]}'")
    return "\n".join(told)


def numbers(text: str) -> list[int]:
    """``0..3,7`` as [0, 1, 2, 3, 7]."""
    found = []
    for part in text.split(","):
        first, _, last = part.partition("..")
        found += range(int(first), int(last or first) + 1)
    return found


def flat(row: Row) -> dict[str, object]:
    """The row for a CSV file; lists and dictionaries as JSON."""
    fit = asdict(row.fit) | {f"forced_{k}": v for k, v in (asdict(row.forced) if row.forced else {}).items()}
    values = {name: value for name, value in asdict(row).items() if name not in ("fit", "forced")} | fit
    return {
        k: json.dumps(v, ensure_ascii=False) if isinstance(v, list | dict) else v for k, v in values.items()
    }


def run(options: argparse.Namespace, work: Path) -> list[Row]:
    """Judge all scenes, one after the other, each in a process of its own."""
    rows = []
    print(HEADER, flush=True)
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn, max_tasks_per_child=1) as pool:
        for seed in options.seeds:
            try:
                row = pool.submit(judged, seed, options.only, work, options.forced).result()
            except Exception as error:  # a fit that breaks is a finding too
                print(f"{seed:4d}  failed: {type(error).__name__}: {error}", flush=True)
                continue
            rows.append(row)
            print(line(row), flush=True)
            if options.output:
                write_csv(options.output, rows)
    return rows


def write_csv(path: Path, rows: list[Row]) -> None:
    """All rows so far; the columns of the forced fits are empty where there was none."""
    table = [flat(row) for row in rows]
    columns = list(dict.fromkeys(name for row in table for name in row))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(table)


def effects(text: str) -> list[str]:
    """Names of effects, separated by commas, or none."""
    names = [] if text == "none" else text.split(",")
    if unknown := set(names) - set(EFFECTS):
        raise argparse.ArgumentTypeError(f"{sorted(unknown)[0]!r} is none of {', '.join(EFFECTS)}")
    return names


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=numbers, default=numbers("0..39"), help="as 0..39 or 3,7,12")
    parser.add_argument("--only", type=effects, default=list(EFFECTS), help="no scene has any other effect")
    parser.add_argument("--forced", action="store_true", help="fit wrong scenes with the true effects too")
    parser.add_argument("--work", type=Path, metavar="FOLDER", help="keep the scenes there")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE.csv")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        rows = run(options, options.work or Path(temporary))
    if failed := len(options.seeds) - len(rows):
        print(f"\n{failed} scenes failed and are left out of what follows")
    print(f"\n{confusion(rows)}\n\n{evidence(rows)}")


if __name__ == "__main__":
    main()

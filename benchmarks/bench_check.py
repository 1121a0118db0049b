"""Which planted mistakes ``endotwin check`` names: ``python benchmarks/bench_check.py SEQUENCE…``.

Each sequence (in C3VD's layout, with a ``camera.json``) is checked as it is; every mistake is planted in one
of them, in turn, or with ``--all`` in each. The confusion table is printed. ``--noise 0.01`` adds 1 % of
white noise to the depth, ``--start K`` begins with another sequence, ``--only WORD`` picks mistakes.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from endotwin.check import check

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from damaged import DAMAGES, Copy


def outcome(planted: set[str], found: set[str]) -> str:
    """In a word, what the check made of a copy."""
    if found == planted:
        return "named" if planted else "clean"
    if planted and planted & found:
        return "named, with more"
    return "MISSED" if planted else "FALSE ALARM"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sequences", type=Path, nargs="+")
    parser.add_argument("--noise", type=float, default=0.0)
    parser.add_argument("--only", default="")
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--all", action="store_true")
    options = parser.parse_args()
    tally, slowest = Counter(), 0.0
    count = len(options.sequences)
    chosen = ["clean"] * (1 if options.all else count) + list(DAMAGES)
    for number, source in enumerate(options.sequences):
        for turn, name in enumerate(chosen):
            if options.only not in name or (not options.all and (turn + options.start) % count != number):
                continue
            with tempfile.TemporaryDirectory() as scratch:
                copy = Copy(source)
                if "alphabetic" in name and len(copy) <= 10:
                    continue  # the order is the same
                if name != "clean":
                    DAMAGES[name].do(copy)
                folder = copy.write(Path(scratch) / "copy", options.noise)
                start = time.perf_counter(), time.process_time()
                report = check(folder)
                seconds = time.perf_counter() - start[0]
                cpu = time.process_time() - start[1]
            named = DAMAGES[name].named if name != "clean" else ()
            found = {finding.kind for finding in report.findings}
            # Of kinds that geometry cannot tell apart, either one is right.
            planted = (
                set(named) & found if found and found <= set(named) and "inverted" not in name else set(named)
            )
            word = outcome(planted, found)
            tally[word] += 1
            slowest = max(slowest, seconds)
            cost = f"{seconds:5.1f} s, CPU {cpu:5.1f} s"
            print(f"{source.name:14} {name:30} {word:17} {cost}  {', '.join(sorted(found))}", flush=True)
    print(dict(tally), f"slowest {slowest:.1f} s")


if __name__ == "__main__":
    main()

"""Writes the pages that a command can make: python docs/write.py [formats] [numerics], both unless named.

formats.md comes from the tables that the code itself works by, numerics.md from what 'endotwin selfcheck'
measures on this machine, in about a minute.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

from endotwin.effects import NAMES, effect_class
from endotwin.selfcheck import run_checks
from endotwin.selfcheck.finding import shown
from endotwin.synth import LABELS, LAYOUTS
from endotwin.synth.encodings import ENCODINGS
from endotwin.synth.run.record import COMMON_WORDS

HERE = Path(__file__).parent

FORMATS = """# What a dataset holds

*Written by `python docs/write.py formats`.*

## Labels

`--labels` takes names joined by commas, or `all`; nothing else is computed. A layout may write a label in
another way, which is said below.

"""

PARAMETERS = """
## Parameters of effects

What `parameters:` of `--vary` edits, with `*`, `+`, `-` or `=` and a number or a range, where the effect is
on. What a twin's effects have is in its `twin.json`; the defaults are of effects that are switched on and
that the photos of the twin's sequence do not tell. A factor or a sum that would lead beyond the least or the
most leads there, and `frames.jsonl` has that factor or sum.

"""

NUMERICS = """# Numerics: what is promised, and what was measured

*Written by `python docs/write.py numerics` from what `endotwin selfcheck` measures.*

`endotwin selfcheck` measures on your machine, in about a minute, what endotwin promises of its numerics (exit
code 1 if a bound is broken; `--json` for scripts). `tests/stability/` asserts the same cases and the slow
ones. Its reference for light and BRDF is 40-digit arithmetic (mpmath). Two honest limits: Disney's diffuse
lobe gains energy at grazing angles on rough surfaces (GGX and Lambert do not), and the 2π of
C = (f·L·(n·ω)·2π)^γ is a factor of L0, no energy.
"""


def table(heading: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """A table in Markdown."""
    lines = [heading, ("---",) * len(heading), *rows]
    return "".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in lines)


def formats() -> str:
    """Labels and layouts, as the code has them."""
    labels = [
        (f"`{label}`", f"`{image}`", f"`{ENCODINGS[image].suffix}`", ENCODINGS[image].words)
        for label, images in LABELS.items()
        for image in images
    ]
    page = FORMATS + table(("label", "image", "file", "what it holds"), labels) + "\n## Layouts\n"
    for layout in LAYOUTS.values():
        words = layout.words | {f"`{image}`": each.words for image, each in layout.encodings.items()}
        words |= {"read back": "by endotwin"} if layout.reads else {}
        words |= {"advice": layout.advice} if layout.advice else {}
        page += f"\n### `{layout.name}`\n\n" + "".join(f"- {name}: {text}\n" for name, text in words.items())
    page += "\n## In every layout\n\n" + "".join(f"- {text}\n" for text in COMMON_WORDS.values())
    return page + PARAMETERS + table(("parameter", "default", "least", "most"), list(_parameters()))


def _parameters() -> Iterator[tuple[str, ...]]:
    """Name, default and bounds of each parameter of the effects that have defaults for all."""
    for name in NAMES:
        if parameters := effect_class(name).parameters():
            effect = effect_class(name)()
            for each in parameters:
                numbers = (getattr(effect, each.name), each.low, each.high)
                yield f"`{name}.{each.name}`", *(f"{number:.4g}" for number in numbers)


def numerics() -> str:
    """Bound and measured value of each case."""
    groups: dict[str, list[tuple[str, ...]]] = {}
    for title, finding in run_checks():
        measured = f"{shown(finding.measured)} {finding.unit}".strip()
        groups.setdefault(title, []).append((finding.case, finding.promise, measured))
    tables = (
        f"\n## {title}\n\n" + table(("case", "bound", "measured"), rows) for title, rows in groups.items()
    )
    return NUMERICS + "".join(tables)


PAGES = {"formats": formats, "numerics": numerics}

if __name__ == "__main__":
    for name in sys.argv[1:] or PAGES:
        (HERE / f"{name}.md").write_text(PAGES[name](), encoding="utf-8")
        print(f"wrote {HERE / name}.md")

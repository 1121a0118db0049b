"""The page: one self-contained HTML file, and the same as a table for the terminal."""

from __future__ import annotations

import base64
import html
import math
from pathlib import Path

from endotwin.tradeoff.by_effect import answer, section
from endotwin.tradeoff.by_effect import table as effects_table
from endotwin.tradeoff.knee import KNEE, knee, pareto_front
from endotwin.tradeoff.ladder import one_line, shell
from endotwin.tradeoff.plot import column

CSS = """
:root { --ink: #1c1c1e; --soft: #6b6b70; --line: #e4e4e7; --accent: #d1495b; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 60rem; padding: 3rem 1.5rem 5rem; color: var(--ink); background: #fff;
  font: 16px/1.55 "Source Serif 4", "Iowan Old Style", Palatino, Georgia, serif; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 .3rem; letter-spacing: -.01em; }
h2 { font-size: 1.2rem; margin: 2.6rem 0 .6rem; }
p.by { color: var(--soft); margin: 0 0 1.6rem; }
p.answer { font-size: 1.1rem; border-left: 3px solid var(--accent); padding-left: 1rem; margin: 1.6rem 0; }
figure { margin: 1.2rem 0; }
figure img { width: 100%; height: auto; }
figcaption, .note { color: var(--soft); font-size: .86rem; line-height: 1.5; }
table { border-collapse: collapse; width: 100%; font: 13px/1.4 system-ui, sans-serif;
  font-variant-numeric: tabular-nums; }
th { font-weight: 600; text-align: right; border-bottom: 1.5px solid var(--ink); padding: .35rem .5rem;
  vertical-align: bottom; }
td { text-align: right; border-bottom: 1px solid var(--line); padding: .3rem .5rem; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
td .range { color: var(--soft); font-size: 11px; }
.effects :is(td, th):not(:first-child) { padding: .3rem .35rem; }
.effects :is(td, th):last-child { text-align: left; white-space: normal; font-size: 11px; min-width: 9rem; }
.effects .on td:first-child { font-weight: 600; }
tr.front td:first-child { font-weight: 600; }
tr.knee td { background: #fdf3f4; } tr.knee td:first-child { color: var(--accent); }
.crops figure { display: inline-block; width: 8.7rem; margin: 0 .6rem .9rem 0; vertical-align: top; }
.crops img { display: block; image-rendering: pixelated; border-radius: 3px; }
.crops figcaption { font: 12px/1.35 system-ui, sans-serif; margin-top: .3rem; }
.crops .knee figcaption { color: var(--accent); font-weight: 600; }
dl { margin: 0; } dt { font: 600 13px/1.4 system-ui, sans-serif; margin-top: .9rem; } dd { margin: 0; }
pre { margin: .2rem 0 0; padding: .5rem .7rem; background: #f7f7f8; border-radius: 4px; overflow-x: auto;
  font: 12px/1.5 ui-monospace, Menlo, Consolas, monospace; }
footer { margin-top: 3rem; border-top: 1px solid var(--line); padding-top: .8rem; }
@media print { body { max-width: none; padding: 0; } table { font-size: 10px; } pre { white-space: pre-wrap; }
  figure, dt { break-inside: avoid; } }
"""


PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title><style>{css}</style></head><body>
<h1>{title}</h1>
<p class="by">{sequence}. {protocol}. {machine}.</p>
<p class="answer">{answer}</p>
<figure><img alt="PSNR and SSIM against seconds, and the seconds of each stage"
 src="data:image/svg+xml;base64,{plot}">
<figcaption>Accuracy on held-out photos, at their own size and over all pixels with depth, against the
wall-clock seconds of fuse and fit. Filled points lie on the Pareto front of their panel; squares are named
configs; bars span the runs. {knee}</figcaption></figure>
<h2>Every rung</h2>
{table}
<p class="note">Seconds are the median of the runs, with their range, Python’s start included; bold rungs are
on the Pareto front of PSNR. Each command ran in a process of its own, and the files of the sequence were
dropped from the page cache before it where the system allows that. Covered pixels are those whose surface
a training photo saw.{busy}</p>
<h2>The same patch</h2>
<div class="crops">{crops}</div>
<p class="note">{patch}: the patch of a held-out photo with the most lit detail, and what each twin shows
there. No photo of this frame was fitted.</p>
{effects}
<h2>Commands</h2>
<dl>{commands}</dl>
<footer class="note">Made by <code>endotwin tradeoff</code>. The numbers are in tradeoff.csv (and
effects.csv where effects were compared), each run’s own in results/.</footer>
</body></html>
"""


def table(rows: list[dict], by_effect: list[dict]) -> str:
    """The rows as aligned text, fastest first, front starred and knee named; effects; commands."""
    seconds, psnr = column(rows, "seconds"), column(rows, "psnr")
    front, best = pareto_front(seconds, psnr), knee(seconds, psnr)
    lines = [["", "rung", "seconds", "PSNR", "SSIM", "PSNR covered", "peak memory"]]
    for index in seconds.argsort():
        row = rows[index]
        lines.append(
            [
                "knee" if index == best else "*" if index in front else "",
                row["rung"],
                f"{row['seconds']:.1f}",
                f"{row['psnr']:.2f}",
                f"{row['ssim']:.4f}",
                f"{row['psnr_covered']:.2f}",
                f"{row['peak_memory_mb'] / 1000:.2f} GB",
            ]
        )
    effects = [*_aligned(effects_table(by_effect)), answer(by_effect), ""] if by_effect else []
    commands = [f"{row['rung']}: {one_line(row['commands'])}" for row in _commanded(rows, by_effect)]
    return "\n".join([*_aligned(lines), "* on the Pareto front", "", *effects, *commands])


def _aligned(lines: list[list[str]]) -> list[str]:
    """Cells as lines of text, in columns."""
    widths = [max(map(len, cells)) for cells in zip(*lines, strict=True)]
    return ["  ".join(map(str.rjust, line, widths)) for line in lines]


def _commanded(rows: list[dict], by_effect: list[dict]) -> list[dict]:
    """The rows with commands, each rung's once: the ladder's, fastest first, then the effects'."""
    named = {row["rung"] for row in rows}
    fitted = [row for row in by_effect if "commands" in row and row["rung"] not in named]
    return [*sorted(rows, key=lambda row: row["seconds"]), *fitted]


def write(rows: list[dict], by_effect: list[dict], facts: dict, work: Path) -> None:
    """Write ``work``/tradeoff.html from the rows, the plots and the crops that lie in ``work``."""
    seconds, psnr = column(rows, "seconds"), column(rows, "psnr")
    front, best = pareto_front(seconds, psnr), knee(seconds, psnr)
    order = [int(index) for index in seconds.argsort()]
    plot = base64.b64encode((work / "tradeoff.svg").read_bytes()).decode()
    geometry = {
        "known": "with known geometry (the depth of held-out frames is fused; their photos are not used)",
        "heldout": "with held-out geometry (neither depth nor photo of held-out frames is used)",
    }[facts["geometry"]]
    title = f"What accuracy costs: {html.escape(facts['name'])}"
    runs = f"{facts['repeats']} runs each" if facts["repeats"] > 1 else "one run each"
    loads = column(_commanded(rows, by_effect), "load")
    busy = (
        f" The load average before the runs was {loads.min():.1f} to {loads.max():.1f}."
        if loads.max() >= 0
        else ""
    )
    page = PAGE.format(
        css=CSS,
        title=title,
        sequence=html.escape(facts["sequence"]),
        protocol=f"{len(rows)} rungs, {runs}, {geometry}",
        machine=html.escape(facts["machine"]),
        answer=_answer(rows, front, best),
        plot=plot,
        knee=KNEE,
        table=_table(rows, order, front, best),
        busy=busy,
        crops=_crops(rows, order, best, work),
        patch=html.escape(facts["patch"]),
        effects=section(by_effect, work),
        commands="".join(map(_commands, _commanded(rows, by_effect))),
    )
    (work / "tradeoff.html").write_text(page, encoding="utf-8")


def _answer(rows: list[dict], front: list[int], best: int | None) -> str:
    """The page's first sentence: what to use."""
    top, fast = rows[front[-1]], rows[front[0]]
    if top is fast:
        return (
            f"No rung beats the fastest, <b>{html.escape(fast['rung'])}</b>: {fast['psnr']:.2f} dB in "
            f"{fast['seconds']:.0f} s."
        )
    ends = (
        f"The fastest, <b>{html.escape(fast['rung'])}</b>, gives {fast['psnr']:.2f} dB in "
        f"{fast['seconds']:.0f} s; the most accurate, <b>{html.escape(top['rung'])}</b>, "
        f"{top['psnr']:.2f} dB in {top['seconds']:.0f} s."
    )
    if best is None:
        return ends
    row = rows[best]
    return (
        f"The knee is <b>{html.escape(row['rung'])}</b>: {row['psnr']:.2f} dB and SSIM {row['ssim']:.4f} "
        f"in {row['seconds']:.0f} s. {ends}"
    )


def _table(rows: list[dict], order: list[int], front: list[int], best: int | None) -> str:
    heads = ("rung", "seconds", "PSNR (dB)", "SSIM", "PSNR covered", "covered", "LPIPS", "peak memory")
    lines = []
    for index in order:
        row = rows[index]
        marks = " ".join(["front"] * (index in front) + ["knee"] * (index == best))
        spread = f" <span class='range'>{row['seconds_min']:.1f}–{row['seconds_max']:.1f}</span>"
        cells = [
            html.escape(row["rung"]) + (" · knee" if index == best else ""),
            f"{row['seconds']:.1f}{spread if row['repeats'] > 1 else ''}",
            f"{row['psnr']:.2f}",
            f"{row['ssim']:.4f}",
            f"{row['psnr_covered']:.2f}",
            f"{row['covered']:.1%}",
            "–" if math.isnan(row["lpips"]) else f"{row['lpips']:.3f}",
            f"{row['peak_memory_mb'] / 1000:.2f} GB",
        ]
        lines.append(f"<tr class='{marks}'>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>")
    return f"<table><tr>{''.join(f'<th>{head}</th>' for head in heads)}</tr>{''.join(lines)}</table>"


def _crops(rows: list[dict], order: list[int], best: int | None, work: Path) -> str:
    shown = [("photo", "photo", "")]
    for index in order:
        row = rows[index]
        caption = f"{html.escape(row['rung'])}<br>{row['seconds']:.0f} s, {row['psnr']:.2f} dB"
        shown.append((row["rung"], caption, " class='knee'" if index == best else ""))
    figures = []
    for name, caption, mark in shown:
        image = base64.b64encode((work / "crops" / f"{name}.png").read_bytes()).decode()
        figures.append(
            f"<figure{mark}><img alt='{html.escape(name)}' src='data:image/png;base64,{image}'>"
            f"<figcaption>{caption}</figcaption></figure>"
        )
    return "".join(figures)


def _commands(row: dict) -> str:
    lines = html.escape("\n".join(shell(command) for command in row["commands"]))
    return f"<dt>{html.escape(row['rung'])}</dt><dd><pre>{lines}</pre></dd>"

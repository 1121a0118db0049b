"""The report's page on effects: what each gains and costs, as a section of HTML and as text."""

from __future__ import annotations

import base64
import html
from pathlib import Path

HEADS = ("effect", "decided", "probe", "PSNR", "covered", "fit", "fit’s peak", "a frame", "kept")
NONE = "–"

SECTION = """<h2>Effect by effect</h2>
<p>{answer}</p>
<figure><img alt="PSNR gained against seconds added by each effect" src="data:image/svg+xml;base64,{plot}">
<figcaption>Each point is one effect: what the fit with it scores more than the fit without, on held-out
photos, and how much longer it takes. Filled ones the fit called for; the others were forced on.</figcaption>
</figure>
<table class="effects"><tr>{heads}<th>why</th></tr>{lines}</table>
<p class="note">One mesh for all. In each fit one effect was forced on where the fit had decided off, or off
where it had decided on, and the others were decided anew. PSNR (dB) over all and over covered pixels, seconds
and peak memory of the fit are with the effect less without: one that buys nothing stands at 0. “Probe” is
what the fit measured on training pixels before it decided; “a frame” what the effect adds to the rendering of
one, “kept” the memory that it holds meanwhile. Effects without a PSNR are rendered on request, never
fitted.</p>"""


def answer(rows: list[dict]) -> str:
    """What was decided, and what that gives."""
    plain, *effects = rows
    on = [row["effect"] for row in effects if row["state"] == "on" and "psnr" in row]
    return (
        f"{plain['rung']} with the effects that the scene calls for ({', '.join(on) or 'none'}): "
        f"{plain['psnr']:.2f} dB, {plain['psnr_covered']:.2f} dB over covered pixels, after a fit of "
        f"{plain['seconds']:.0f} s; a frame renders in {plain['frame_ms']:.0f} ms."
    )


def table(rows: list[dict]) -> list[list[str]]:
    """``effects.rows`` as cells, under HEADS."""
    return [list(HEADS), *(_cells(row) for row in rows[1:])]


def section(rows: list[dict], work: Path) -> str:
    """The page's section, with the plot that lies in ``work``; nothing where no effects were compared."""
    if not rows:
        return ""
    lines = []
    for row in rows[1:]:
        cells = "".join(f"<td>{cell}</td>" for cell in _cells(row))
        lines.append(f"<tr class='{row['state']}'>{cells}<td>{html.escape(_why(row))}</td></tr>")
    return SECTION.format(
        answer=html.escape(answer(rows)),
        plot=base64.b64encode((work / "effects.svg").read_bytes()).decode(),
        heads="".join(f"<th>{head}</th>" for head in HEADS),
        lines="".join(lines),
    )


def _cells(row: dict) -> list[str]:
    probe = NONE if row["probe_db"] == "" else f"{row['probe_db']:+.2f}"
    gains = [NONE] * 4
    if "psnr_gain" in row:
        gains = [
            f"{row['psnr_gain']:+.2f}",
            f"{row['psnr_covered_gain']:+.2f}",
            f"{row['seconds_added']:+.1f} s",
            f"{row['peak_memory_added_mb']:+.0f} MB",
        ]
    price = [f"{row['render_ms']:.1f} ms", f"{row['memory_mb']:.0f} MB"]
    return [row["effect"], row["state"], probe, *gains, *price]


def _why(row: dict) -> str:
    """The evidence, and what forcing the effect did beside it."""
    told = [row["reason"]]
    if row.get("forced") == row["state"]:
        told.append(f"could not be forced: still {row['forced']}")
    if row.get("also"):
        told.append(f"forced {row['forced']}, the fit also decided {row['also']}")
    return "; ".join(told)

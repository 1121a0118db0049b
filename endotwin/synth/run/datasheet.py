"""The datasheet: one self-contained page that shows what a dataset holds."""

from __future__ import annotations

from html import escape
from pathlib import Path

import numpy as np

from endotwin.synth.proof import Proof
from endotwin.synth.proof.claims import HEADINGS
from endotwin.synth.run.statistics import BRIGHTNESS_BINS, COVERAGE, DEPTH_BINS_MM, Statistics

STYLE = (
    "body{font:15px/1.5 system-ui,sans-serif;max-width:1100px;margin:2em auto;padding:0 1em;color:#1a1d22}"
    "h1{font-size:1.5em}h2{font-size:1.15em;margin-top:2em}.pictures{display:flex;flex-wrap:wrap;gap:6px}"
    "figure{margin:0}figcaption{font-size:12px;color:#667}svg{background:#f4f5f7}"
    "td,th{text-align:left;vertical-align:top;padding:2px 14px 2px 0}th{white-space:nowrap}"
    ".charts{display:flex;flex-wrap:wrap;gap:24px}"
)
COLORS = {"valid": "#2a9d8f", "unseen": "#e9c46a", "filled": "#e76f51", "none": "#c9ccd2"}
WIDTH, HEIGHT = 340, 150
COLUMNS = 340


def write_datasheet(path: Path, document: dict, statistics: Statistics, proof: Proof) -> None:
    """Write the page for a dataset of this ``dataset.json``; the same content gives the same bytes."""
    sections = [
        f"<h1>{document['frames']} frames of {escape(document['twin']['sequence'])}, {document['format']} "
        f"layout</h1>",
        f"<p>{escape(document['trajectory'])}. Labels: {', '.join(document['labels'])}. Seed "
        f"{document['seed']}.</p>",
        _pictures(statistics),
        f'<div class="charts">{_charts(statistics)}</div>',
        _proven(proof),
        _table("Poses", document["poses"]),
        _table("Limits of the poses", document["limits"]),
        _table("Variation", _flat(document["variation"])),
        _table("Motion", _flat(document.get("motion", {}))),
        _table("Polyps", dict(map(_polyp, document.get("polyps", ())))),
        _table("Fluids", dict(map(_fluid, document.get("fluids", ())))),
        _table("Twin", _flat(document["twin"])),
        _table("Camera", document["camera"]),
        _table("Conventions", document["conventions"]),
        _table("Versions", document["versions"]),
        f"<h2>Licence</h2><p>{escape(document['license_note'])}</p>",
    ]
    head = '<!doctype html><html lang="en"><meta charset="utf-8"><title>endotwin dataset</title>'
    head += f"<style>{STYLE}</style>"
    path.write_text(
        head + "\n".join(section for section in sections if section) + "\n",
        encoding="utf-8",
        errors="backslashreplace",
    )


def _polyp(polyp: dict) -> tuple[str, str]:
    """Number and description of a polyp."""
    x, y, z = polyp["place_mm"]
    return str(polyp["number"]), (
        f"{polyp['paris']}, {polyp['size_mm']:.1f} mm wide, {polyp['height_mm']:.1f} mm high, at "
        f"({x:.1f}, {y:.1f}, {z:.1f}) mm"
    )


def _fluid(fluid: dict) -> tuple[str, str]:
    """Number and description of a patch of fluid."""
    x, y, z = fluid["place_mm"]
    return str(fluid["number"]), (
        f"{fluid['kind']}{', a pool' if fluid['pool'] else ''}, {fluid['size_mm']:.1f} mm wide, up to "
        f"{fluid['thickness_mm']:.2f} mm thick, at ({x:.1f}, {y:.1f}, {z:.1f}) mm"
    )


def _pictures(statistics: Statistics) -> str:
    figures = [
        f'<figure><img src="data:image/jpeg;base64,{picture}" alt="frame {index}" width="170">'
        f"<figcaption>{index}</figcaption></figure>"
        for index, picture in sorted(statistics.thumbnails.items())
    ]
    return f'<div class="pictures">{"".join(figures)}</div>'


def _charts(statistics: Statistics) -> str:
    charts = [
        _histogram("Depth, mm (share of the pixels)", statistics.depth, DEPTH_BINS_MM),
        _histogram("Brightness, 0 to 1 (share of the pixels)", statistics.brightness, BRIGHTNESS_BINS),
        _coverage(statistics),
    ]
    return "".join(charts)


def _histogram(title: str, counts: np.ndarray, edges: np.ndarray) -> str:
    if not counts.sum():
        return ""
    shares = counts / counts.sum()
    width = WIDTH / len(counts)
    bars = "".join(
        f'<rect x="{k * width:.2f}" y="{HEIGHT * (1 - share / shares.max()):.2f}" width="{width:.2f}" '
        f'height="{HEIGHT * share / shares.max():.2f}" fill="#4a6fa5">'
        f"<title>{edges[k]:.4g} to {edges[k + 1]:.4g}: {share:.2%}</title></rect>"
        for k, share in enumerate(shares)
    )
    return _figure(title, bars, f"{edges[0]:g} … {edges[-1]:g}; highest bar {shares.max():.1%}")


def _coverage(statistics: Statistics) -> str:
    """Stacked shares over the frames, in at most COLUMNS columns."""
    frames = len(statistics.coverage["valid"])
    if not frames:
        return ""
    groups = np.array_split(np.arange(frames), min(frames, COLUMNS))
    width = WIDTH / len(groups)
    bars, base = [], np.zeros(len(groups))
    for kind in COVERAGE:
        shares = np.array([np.mean(np.take(statistics.coverage[kind], group)) for group in groups])
        bars += [
            f'<rect x="{k * width:.2f}" y="{HEIGHT * (1 - base[k] - share):.2f}" width="{width + 0.1:.2f}" '
            f'height="{HEIGHT * share:.2f}" fill="{COLORS[kind]}"/>'
            for k, share in enumerate(shares)
            if share > 0
        ]
        base += shares
    legend = ", ".join(f"{kind} {share:.1%}" for kind, share in statistics.mean_coverage().items())
    return _figure("Coverage, frame by frame", "".join(bars), legend)


def _figure(title: str, drawing: str, caption: str) -> str:
    return (
        f'<figure><h2>{title}</h2><svg viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}">'
        f"{drawing}</svg>"
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _proven(proof: Proof) -> str:
    """The table of what labels claim of each other, and whether it holds."""
    rows = [HEADINGS, *(row.cells() for row in proof.rows)]
    cells = ("".join(f"<td>{escape(cell)}</td>" for cell in row) for row in rows)
    table = "".join(f"<tr>{row}</tr>" for row in cells) if proof.rows else ""
    return (
        f"<h2>Consistency</h2><p>{escape(proof.verdict)} 'endotwin check DATASET --labels' compares more.</p>"
        f"<table>{table}</table>"
    )


def _table(title: str, content: dict) -> str:
    rows = "".join(
        f"<tr><th>{escape(str(name))}</th><td>{escape('no limit' if value is None else str(value))}</td></tr>"
        for name, value in content.items()
        if value not in ({}, [], "")
    )
    return f"<h2>{title}</h2><table>{rows}</table>" if rows else ""


def _flat(content: dict, prefix: str = "") -> dict:
    """Nested keys joined by dots; lists as text."""
    flat = {}
    for name, value in content.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = ", ".join(map(str, value)) if isinstance(value, list) else value
    return flat

"""The plot: accuracy against seconds, each stage's share, and the memory."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, LogLocator, ScalarFormatter

from endotwin.effects import FITTED
from endotwin.tradeoff.knee import knee, pareto_front

STYLE = {
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#999999",
    "axes.labelcolor": "#333333",
    "axes.linewidth": 0.8,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "xtick.color": "#666666",
    "ytick.color": "#666666",
    "xtick.labelcolor": "#333333",
    "ytick.labelcolor": "#333333",
    "svg.hashsalt": "endotwin",
}
KNOB_COLORS = (
    "#d1495b",
    "#2e86ab",
    "#e39c2c",
    "#3d9970",
    "#8e6bbf",
    "#a1674a",
    "#5f9ea0",
    "#c2679b",
    "#7a8b2f",
    "#6c757d",
    "#3b4cc0",
)
PRESET_COLOR, FRONT_COLOR, KNEE_COLOR = "#222222", "#bbbbbb", "#d1495b"
STAGE_COLORS = {
    "start-up and files": "#d5d5d5",
    "TSDF": "#b7d3e6",
    "refine": "#86b4d4",
    "carve and patch": "#4f8fbd",
    "coverage": "#2b6493",
    "gather": "#fbdcab",
    "closed form": "#f6bd72",
    "effects": "#f29e4c",
    "light": "#e07b39",
    "detail": "#b8502a",
    "train": "#9b7ebd",
    "bake": "#6a4c93",
}
LINEAR_DB, STEPS_DB = 0.1, (0.1, 0.3, 1, 3, 10, 30)
OTHER_STAGES = ("#7fbf9b", "#4d9a72", "#2a6f4e")


def draw(rows: list[dict], files: list[Path]) -> None:
    """Draw the rows of ``run.summary`` and write the figure to each of ``files``, by their suffix."""
    with plt.rc_context(STYLE):
        height = 4.6 + 0.24 * len(rows)
        figure = plt.figure(figsize=(10, height), layout="constrained")
        grid = figure.add_gridspec(2, 2, height_ratios=[4.0, 0.6 + 0.24 * len(rows)])
        best = knee(column(rows, "seconds"), column(rows, "psnr"))
        colors = knob_colors(rows)
        first = figure.add_subplot(grid[0, 0])
        _scatter(first, rows, "psnr", "PSNR (dB)", best, colors)
        keys = [
            Line2D([], [], color=color, marker="o", ls="", ms=5, label=knob) for knob, color in colors.items()
        ]
        first.legend(handles=keys, fontsize=7.5, frameon=False, loc="best", handletextpad=0.1)
        _scatter(figure.add_subplot(grid[0, 1]), rows, "ssim", "SSIM", best, colors)
        bars = figure.add_subplot(grid[1, :])
        _bars(bars, rows, best)
        figure.legend(*bars.get_legend_handles_labels(), ncols=6, frameon=False, loc="outside lower center")
        _save(figure, files)


def draw_effects(rows: list[dict], files: list[Path]) -> None:
    """Draw what each fitted effect of ``effects.rows`` gains against the seconds that it adds."""
    tried = [row for row in rows if "psnr_gain" in row]
    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
        for axes, score in zip(panels, ("psnr", "psnr_covered"), strict=True):
            _gains(axes, tried, f"{score}_gain")
            pixels = "covered pixels" if "covered" in score else "whole frame"
            label = "PSNR with less without (dB)"
            axes.set(xlabel="fit with less without (s)", ylabel=label, title=f"Gain, {pixels}")
        keys = {"the fit called for it": "#444444", "forced on": "white"}
        points = [
            Line2D([], [], color="#444444", mfc=fill, marker="o", ls="", ms=5, label=key)
            for key, fill in keys.items()
        ]
        figure.legend(handles=points, ncols=2, frameon=False, loc="outside lower center")
        _save(figure, files)


def _gains(axes: Axes, rows: list[dict], gain: str) -> None:
    """One named point an effect, in a scale that is linear below LINEAR_DB and logarithmic above."""
    seconds, gains = column(rows, "seconds_added"), column(rows, gain)
    axes.axhline(0, color=FRONT_COLOR, lw=1, zorder=1)
    axes.axvline(0, color=FRONT_COLOR, lw=1, zorder=1)
    colors = [KNOB_COLORS[FITTED.index(row["effect"]) % len(KNOB_COLORS)] for row in rows]
    for x, y, color, row in zip(seconds, gains, colors, rows, strict=True):
        filled = {} if row["state"] == "on" else {"mfc": "white"}
        axes.plot(x, y, "o", ms=6, color=color, zorder=3, **filled)
    axes.margins(x=0.25, y=0.15)
    axes.set_yscale("asinh", linear_width=LINEAR_DB)
    axes.yaxis.set_major_locator(FixedLocator([0, *(sign * step for sign in (-1, 1) for step in STEPS_DB)]))
    axes.yaxis.set_major_formatter("{x:+g}")
    scaled, ends = np.arcsinh(gains / LINEAR_DB), np.arcsinh(np.array(axes.get_ylim()) / LINEAR_DB)
    for index, height in _apart(seconds, scaled, 0.2 * np.ptp(axes.get_xlim()), 0.05 * np.ptp(ends)).items():
        _name(axes, rows[index]["effect"], seconds[index], LINEAR_DB * np.sinh(height), colors[index])


def _save(figure: Figure, files: list[Path]) -> None:
    for file in files:
        figure.savefig(file, dpi=160, metadata={"Date": None} if file.suffix == ".svg" else None)
    plt.close(figure)


def column(rows: list[dict], name: str) -> np.ndarray:
    """One value a row, float [N]."""
    return np.array([row[name] for row in rows], float)


def knob_colors(rows: list[dict]) -> dict[str, str]:
    """A colour for each knob that the rows turn."""
    knobs = list(dict.fromkeys(row["knob"] for row in rows))
    turned = [knob for knob in knobs if knob not in ("preset", "file")]
    cycle = {knob: KNOB_COLORS[number % len(KNOB_COLORS)] for number, knob in enumerate(turned)}
    return {knob: cycle.get(knob, PRESET_COLOR) for knob in knobs}


def _scatter(
    axes: Axes, rows: list[dict], score: str, label: str, best: int | None, colors: dict[str, str]
) -> None:
    """Accuracy against seconds, with the Pareto front; bars span the repeats."""
    seconds, values = column(rows, "seconds"), column(rows, score)
    front = pareto_front(seconds, values)
    axes.plot(seconds[front], values[front], color=FRONT_COLOR, lw=1.2, zorder=1, drawstyle="steps-post")
    for index, row in enumerate(rows):
        across = [[seconds[index] - row["seconds_min"]], [row["seconds_max"] - seconds[index]]]
        along = [[values[index] - row[f"{score}_min"]], [row[f"{score}_max"] - values[index]]]
        style = {"color": colors[row["knob"]], "zorder": 3 if index in front else 2}
        marker = "s" if row["knob"] in ("preset", "file") else "o"
        filled = {} if index in front else {"mfc": "white"}
        axes.errorbar(
            seconds[index], values[index], along, across, fmt=marker, ms=5, lw=0.8, **style, **filled
        )
    if best is not None:
        axes.plot(seconds[best], values[best], "o", ms=14, mfc="none", mec=KNEE_COLOR, mew=1.4, zorder=4)
    named = [
        index for index, row in enumerate(rows) if index in front or row["knob"] in ("preset", "endopbr")
    ]
    log, line = np.log10(seconds[named]), 0.045 * (np.ptp(values) or 1.0)
    for place, height in _apart(log, values[named], 0.35, line).items():
        index = named[place]
        text = rows[index]["rung"].replace("method=endopbr+budget=", "endopbr, ")
        if index == best:
            _name(axes, "knee: " + text, seconds[index], height, KNEE_COLOR)
        else:
            _name(axes, text, seconds[index], height)
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_formatter("")
    axes.ticklabel_format(axis="y", useOffset=False)
    axes.margins(x=0.12, y=0.1)
    axes.grid(True, color="#eeeeee", lw=0.8)
    axes.set_axisbelow(True)
    axes.set(xlabel="fuse + fit (s, log scale)", ylabel=label, title=f"{label.split()[0]}, held-out photos")


def _apart(x: np.ndarray, y: np.ndarray, near: float, line: float) -> dict[int, float]:
    """Heights for the names of points, by index: a line apart where the points are near in x."""
    heights: dict[int, float] = {}
    for index in np.argsort(-y):
        height = y[index]
        while any(abs(x[index] - x[at]) < near and abs(height - up) < line for at, up in heights.items()):
            height -= line
        heights[int(index)] = height
    return heights


def _name(axes: Axes, text: str, x: float, y: float, color: str = "#444444") -> None:
    """Write the name of a point beside it."""
    axes.annotate(text, (x, y), (9, 0), textcoords="offset points", fontsize=7.5, va="center", color=color)


def _bars(axes: Axes, rows: list[dict], best: int | None) -> None:
    """Each stage's seconds, stacked, one bar a rung from the fastest down, and the peak memory beside it."""
    order = np.argsort(column(rows, "seconds"))
    stages = list(dict.fromkeys(name for row in rows for name in row["stages"]))
    stages.sort(
        key=lambda name: list(STAGE_COLORS).index(name) if name in STAGE_COLORS else len(STAGE_COLORS)
    )
    others = iter(OTHER_STAGES * len(stages))
    left = np.zeros(len(rows))
    for name in stages:
        width = np.array([rows[index]["stages"].get(name, 0.0) for index in order])
        color = STAGE_COLORS.get(name) or next(others)
        axes.barh(
            range(len(rows)), width, left=left, color=color, label=name, height=0.72, ec="white", lw=0.4
        )
        left += width
    for place, index in enumerate(order):
        row = rows[index]
        text = f"  {row['seconds']:.1f} s · {row['peak_memory_mb'] / 1000:.2f} GB"
        axes.text(left[place], place, text, va="center", fontsize=7.5, color="#444444")
    names = [rows[index]["rung"].replace("method=endopbr+budget=", "endopbr, ") for index in order]
    axes.set_yticks(range(len(rows)), names, fontsize=8)
    if best is not None:
        axes.get_yticklabels()[list(order).index(best)].set(color=KNEE_COLOR, weight="bold")
    axes.invert_yaxis()
    axes.set_xlim(0, 1.16 * left.max())
    axes.tick_params(axis="y", length=0)
    axes.set(xlabel="seconds, median run; total and peak memory beside the bar", title="Where the time goes")

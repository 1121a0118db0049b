"""The plot: errors of each arm, against depth, against the number of frames, and by ingredient."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from endotwin.study.accuracy import EDGES_MM
from endotwin.study.arms import HEADLINE
from endotwin.study.recipe import HELPED
from endotwin.tradeoff.plot import KNOB_COLORS, STYLE

if TYPE_CHECKING:
    from endotwin.study.report import Findings

COLORS = {"zero-shot": "#999999", "real": "#e39c2c", "rendered": "#2e86ab", "both": "#d1495b"}
TEST_STYLES = ("-", "--", ":", "-.")


def draw(findings: Findings, files: list[Path]) -> None:
    """Draw the figure and write it to each of ``files``, by their suffix."""
    panels = [_headline, _by_depth]
    panels += [_curve] if findings.part("curve") else []
    panels += [_ingredients] if findings.part("ingredients") else []
    with plt.rc_context(STYLE):
        rows = -(-len(panels) // 2)
        figure, axes = plt.subplots(rows, 2, figsize=(10, 3.8 * rows), layout="constrained", squeeze=False)
        for place, panel in zip(axes.flat, panels, strict=False):
            panel(place, findings)
        for place in axes.flat[len(panels) :]:
            place.set_visible(False)
        for file in files:
            figure.savefig(file, dpi=160, metadata={"Date": None} if file.suffix == ".svg" else None)
        plt.close(figure)


def captions(findings: Findings) -> list[str]:
    """What each panel of the figure shows, in its order."""
    texts = [
        "AbsRel of the headline's arms: bars are means over the seeds, points the seeds; what is hatched is "
        "scaled by each image's median.",
        "Mean |p−d|/d of all pixels at a depth, of all seeds.",
    ]
    if findings.part("curve"):
        texts.append("AbsRel against the number of rendered frames, at equal steps.")
    if findings.part("ingredients"):
        texts.append(
            "What each ingredient changes of AbsRel against novel poses alone: left of 0 it helps; bars span "
            "one standard error."
        )
    return texts


def _headline(axes: Axes, findings: Findings) -> None:
    arms = findings.part("headline")
    tests = findings.facts["tests"]
    width = 0.8 / len(arms)
    for place, arm in enumerate(arms):
        for test in range(len(tests)):
            left = test - 0.4 + width * (place + 0.5)
            for kind, fill in (("metric", {"alpha": 0.85}), ("scaled", {"fill": False, "hatch": "////"})):
                values = findings.values(arm.name, test, "abs_rel", kind)
                axes.bar(
                    left, values.mean(), 0.9 * width, color=COLORS[arm.name], ec=COLORS[arm.name], **fill
                )
                if kind == "metric":
                    axes.plot(
                        np.full(len(values), left), values, "o", ms=3, color="#333333", mec="white", mew=0.4
                    )
    handles = [plt.Rectangle((0, 0), 1, 1, color=COLORS[arm.name]) for arm in arms]
    axes.legend(handles, [arm.name for arm in arms], frameon=False, fontsize=8)
    axes.set_xticks(range(len(tests)), tests)
    axes.set(ylabel="AbsRel", title="Trained on")


def _by_depth(axes: Axes, findings: Findings) -> None:
    middles = (EDGES_MM[1:] + EDGES_MM[:-1]) / 2
    for arm in HEADLINE:
        for test, name in enumerate(findings.facts["tests"]):
            found = [
                [np.nan if v is None else v for v in run[test]["by_depth"]] for run in findings.runs[arm.name]
            ]
            style = TEST_STYLES[test % len(TEST_STYLES)]
            label = name if arm is HEADLINE[0] else None
            axes.plot(middles, np.mean(found, axis=0), style, color=COLORS[arm.name], lw=1.3, label=label)
    axes.legend(frameon=False, fontsize=8)
    for line in axes.get_legend().get_lines():
        line.set_color("#444444")
    axes.set(xlabel="depth (mm)", ylabel="mean |p−d|/d", title="Error against depth", ylim=(0, None))


def _curve(axes: Axes, findings: Findings) -> None:
    arms = [*findings.part("curve"), next(arm for arm in HEADLINE if arm.name == "rendered")]
    counts = [arm.frames or findings.facts["frames"]["rendered"] for arm in arms]
    for test, name in enumerate(findings.facts["tests"]):
        values = np.array([findings.values(arm.name, test, "abs_rel") for arm in arms])
        color = KNOB_COLORS[test % len(KNOB_COLORS)]
        axes.plot(counts, values.mean(axis=1), "o-", ms=4, lw=1.3, color=color, label=name)
        axes.fill_between(counts, values.min(axis=1), values.max(axis=1), color=color, alpha=0.15, lw=0)
        real = findings.values("real", test, "abs_rel").mean()
        axes.axhline(real, color=color, lw=0.8, ls=":")
    axes.set_xscale("log")
    axes.set_xticks(counts, list(map(str, counts)))
    axes.minorticks_off()
    axes.legend(framealpha=1, edgecolor="none", fontsize=8)
    axes.set(xlabel="rendered frames (dotted: real ones)", ylabel="AbsRel", title="More frames, equal steps")


def _ingredients(axes: Axes, findings: Findings) -> None:
    base, *others = findings.part("ingredients")
    arms = [*others, next(arm for arm in HEADLINE if arm.name == "rendered")]
    tests = findings.facts["tests"]
    height = 0.8 / len(tests)
    for test, name in enumerate(tests):
        plain = findings.values(base.name, test, "abs_rel")
        for place, arm in enumerate(arms):
            values = findings.values(arm.name, test, "abs_rel")
            percent = 100 * (values.mean() / plain.mean() - 1)
            error = 100 * np.hypot(_error(values), _error(plain)) / plain.mean()
            at = place - 0.4 + height * (test + 0.5)
            color = KNOB_COLORS[test % len(KNOB_COLORS)]
            label = name if place == 0 else None
            axes.barh(at, percent, 0.9 * height, color=color, label=label, xerr=error, error_kw={"lw": 0.8})
    axes.axvline(0, color="#333333", lw=0.8)
    helped = "+".join(recipe.name for recipe in HELPED)
    axes.set_yticks(range(len(arms)), [*(arm.name for arm in others), f"rendered: {helped}"])
    axes.invert_yaxis()
    axes.legend(frameon=False, fontsize=8)
    axes.set(xlabel="change of AbsRel against novel poses alone (%)", title="Ingredients")


def _error(values: np.ndarray) -> float:
    """Standard error of the mean; 0 of one value."""
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else 0.0

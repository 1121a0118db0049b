"""What was found: as a table for the terminal, as CSV, and as one self-contained page."""

from __future__ import annotations

import base64
import csv
import html
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import ttest_ind

from endotwin.study import plot
from endotwin.study.accuracy import METRICS, NAMES
from endotwin.study.arms import HEADLINE, Arm
from endotwin.study.corruptions import BENCHMARK
from endotwin.study.depth_anything import WEIGHTS
from endotwin.tradeoff.report import CSS

ZERO_SHOT = Arm("zero-shot", "headline")
BY_CHANCE = 0.05
"""A difference between two arms' means over seeds that chance makes more often than this is not claimed."""


@dataclass(frozen=True)
class Findings:
    """All results.

    Attributes:
        facts: of the experiment, in words and numbers. arms: that have results.
        runs: of each arm by name, one a seed, each a list of ``judge.judged`` of the tests.
        robustness: ``judge.judged_corrupted`` of each test; empty where that was not asked for.
    """

    facts: dict
    arms: list[Arm]
    runs: dict[str, list[list[dict]]]
    robustness: list[dict]

    @classmethod
    def read(cls, work: Path, arms: list[Arm], seeds: int, facts: dict) -> Findings:
        """The results that lie in ``work``."""
        results = work / "results"
        if (results / "zero-shot.0.json").exists():
            arms = [ZERO_SHOT, *arms]
        found = {
            arm.name: [
                _read(results / f"{arm.name}.{seed}.json") for seed in range(1 if arm is ZERO_SHOT else seeds)
            ]
            for arm in arms
        }
        runs = {name: [result["scores"] for result in each] for name, each in found.items()}
        seconds = sum(result["seconds"] for each in found.values() for result in each)
        files = [results / f"robustness.{test}.json" for test in range(len(facts["tests"]))]
        robustness = [_read(file) for file in files if file.exists()]
        facts = {**facts, "seconds": seconds}
        return cls(facts, arms, runs, robustness)

    def values(self, arm: str, test: int, metric: str, kind: str = "metric") -> np.ndarray:
        """A metric of an arm on a test, one a seed, float [S]; kind: metric, or scaled by the median."""
        return np.array([run[test][kind][metric] for run in self.runs[arm]], float)

    def part(self, name: str) -> list[Arm]:
        """The arms of one part of the experiment."""
        return [arm for arm in self.arms if arm.part == name]


def _read(file: Path) -> dict:
    return json.loads(file.read_text(encoding="utf-8"))


def table(findings: Findings) -> str:
    """Mean ± standard deviation over the seeds, a block a test, as aligned text."""
    lines = []
    for test, name in enumerate(findings.facts["tests"]):
        rows = [[name, *_columns()]]
        rows += [[arm.name, *_cells(findings, arm, test)] for arm in findings.arms]
        widths = [max(map(len, cells)) for cells in zip(*rows, strict=True)]
        lines += ["  ".join(map(str.rjust, row, widths)) for row in rows] + [""]
    return "\n".join([*lines, answer(findings)])


def _columns() -> list[str]:
    return [*(NAMES[metric] for metric in METRICS), "scaled AbsRel", "scaled δ<1.25"]


def _cells(findings: Findings, arm: Arm, test: int) -> list[str]:
    shown = [*((metric, "metric") for metric in METRICS), ("abs_rel", "scaled"), ("d1", "scaled")]
    return [_spread(findings.values(arm.name, test, *each)) for each in shown]


def _spread(values: np.ndarray) -> str:
    digits = 2 if values.mean() > 1 else 3
    return f"{values.mean():.{digits}f}" + (f"±{values.std(ddof=1):.{digits}f}" if len(values) > 1 else "")


def answer(findings: Findings) -> str:
    """In a sentence a test: how rendered frames compare with real ones, and both with either."""
    said = [_answer(findings, test, name) for test, name in enumerate(findings.facts["tests"])]
    chance = ["Of one seed: any difference may be chance."] if findings.facts["seeds"] == 1 else []
    return " ".join([*said, *chance])


def _answer(findings: Findings, test: int, name: str) -> str:
    real, rendered, both = (findings.values(arm.name, test, "abs_rel") for arm in HEADLINE)
    word = (
        "like" if _alike(rendered, real) else "better than" if rendered.mean() < real.mean() else "worse than"
    )
    best = np.minimum(real.mean(), rendered.mean())
    either = real if real.mean() < rendered.mean() else rendered
    more = "as good as" if _alike(both, either) else "better than" if both.mean() < best else "worse than"
    return (
        f"{name}: trained on rendered frames AbsRel is {rendered.mean():.3f}, {word} on real ones "
        f"({real.mean():.3f}); both together are {more} the better of them ({both.mean():.3f})."
    )


def _alike(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether the seeds leave open which of two arms is ahead (Welch's t-test, 1947)."""
    return min(len(a), len(b)) > 1 and bool(ttest_ind(a, b, equal_var=False).pvalue >= BY_CHANCE)


def write(findings: Findings, work: Path) -> None:
    """Write ``depth.csv``, ``depth.png``, ``depth.svg`` and ``depth.html`` to ``work``."""
    _write_csv(findings, work / "depth.csv")
    plot.draw(findings, [work / "depth.png", work / "depth.svg"])
    facts = findings.facts
    picture = base64.b64encode((work / "depth.svg").read_bytes()).decode()
    page = PAGE.format(
        css=CSS,
        title=f"What a dataset is worth: depth on {html.escape(', '.join(facts['tests']))}",
        protocol=html.escape(_protocol(facts)),
        answer=html.escape(answer(findings)),
        plot=picture,
        captions=" ".join(plot.captions(findings)),
        tables="".join(_html_table(findings, test) for test in range(len(facts["tests"]))),
        robustness=_robustness(findings),
        arms="".join(
            f"<dt>{html.escape(arm.name)}</dt><dd>{html.escape(_seen(arm))}</dd>" for arm in findings.arms
        ),
        unseen=html.escape(facts["unseen"]),
        commands="".join(f"<pre>{html.escape(line)}</pre>" for line in commands(work)),
    )
    (work / "depth.html").write_text(page, encoding="utf-8")


def _seen(arm: Arm) -> str:
    few = f" ({arm.frames} of them)" if arm.frames else ""
    return arm.words + few if arm.words else f"nothing: the weights of {WEIGHTS} as they are"


def _protocol(facts: dict) -> str:
    frames = facts["frames"]
    return (
        f"{facts['network']} network, {facts['parameters'] / 1e6:.2f} M trained parameters, images of "
        f"{facts['size']} pixels. Every arm: {facts['steps']} steps of {facts['batch']} photos, loss "
        f"{facts['loss']}, {facts['seeds']} seeds. {frames['real']} real frames of "
        f"{', '.join(facts['real'])}; {frames['rendered']} frames rendered from "
        f"{', '.join(facts['twins'])} at new poses ({facts['trajectory']}). {facts['machine']}, "
        f"{facts['seconds'] / 60:.0f} minutes of rendering, training and judging."
    )


def commands(work: Path) -> list[str]:
    """What rendered each dataset, as a user would type it."""
    lines = []
    for file in sorted((work / "recipes").glob("*.command.json")):
        name, asked = file.name.removesuffix(".command.json"), _read(file)
        recipe = name.rpartition("-")[0]
        lines.append(
            f"endotwin synth TWIN --trajectory {asked['trajectory']} --vary recipes/{recipe}.yaml --camera "
            f"recipes/{name}.camera.json --labels {asked['labels']} --layout {asked['layout']} --seed "
            f"{asked['seed']} -o {name}"
        )
    return lines


def _html_table(findings: Findings, test: int) -> str:
    head = "".join(f"<th>{html.escape(each)}</th>" for each in _columns())
    rows = ""
    best = min(findings.values(arm.name, test, "abs_rel").mean() for arm in findings.arms)
    for arm in findings.arms:
        mark = ' class="knee"' if findings.values(arm.name, test, "abs_rel").mean() == best else ""
        cells = "".join(f"<td>{cell}</td>" for cell in _cells(findings, arm, test))
        rows += f"<tr{mark}><td>{html.escape(arm.name)}</td>{cells}</tr>"
    name, count = findings.facts["tests"][test], findings.facts["test_frames"][test]
    return f"<h3>{html.escape(name)}, {count} frames</h3><table><tr><th></th>{head}</tr>{rows}</table>"


def robust_means(findings: Findings, test: int, arm: str) -> dict[str, float]:
    """AbsRel of an arm: ``clean``, each corruption's mean over its severities, ``mean`` of the sixteen."""
    found = {name: float(np.mean(values)) for name, values in findings.robustness[test][arm].items()}
    return {**found, "mean": float(np.mean([found[name] for name in BENCHMARK]))}


def _robustness(findings: Findings) -> str:
    if not findings.robustness:
        return ""
    text = (
        "<h2>After corruption</h2><p class='note'>AbsRel, each image scaled by its median, of the first seed "
        "on 12 evenly spread frames; the mean of five severities. The mean is over the sixteen of "
        "EndoscopyCorruptions; jpeg is that of imagecorruptions.</p>"
    )
    for test, name in enumerate(findings.facts["tests"]):
        means = {arm.name: robust_means(findings, test, arm.name) for arm in HEADLINE}
        head = "".join(f"<th>{arm}</th>" for arm in means)
        kinds = [
            "clean",
            "mean",
            *(kind for kind in next(iter(means.values())) if kind not in ("clean", "mean")),
        ]
        rows = "".join(
            f"<tr><td>{kind}</td>{''.join(f'<td>{means[arm][kind]:.3f}</td>' for arm in means)}</tr>"
            for kind in kinds
        )
        text += f"<h3>{html.escape(name)}</h3><table><tr><th></th>{head}</tr>{rows}</table>"
    return text


def _write_csv(findings: Findings, path: Path) -> None:
    """One line a test, arm, seed and kind of score."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["test", "arm", "seed", "scale", *METRICS])
        for test, name in enumerate(findings.facts["tests"]):
            for arm in findings.arms:
                for seed, run in enumerate(findings.runs[arm.name]):
                    for kind in ("metric", "scaled"):
                        values = [f"{run[test][kind][metric]:.6g}" for metric in METRICS]
                        writer.writerow([name, arm.name, seed, kind, *values])


PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title><style>{css} h3 {{ font-size: 1rem; margin: 1.6rem 0 .3rem; }}</style></head><body>
<h1>{title}</h1>
<p class="by">{protocol}</p>
<p class="answer">{answer}</p>
<figure><img alt="Errors of each arm" src="data:image/svg+xml;base64,{plot}">
<figcaption>{captions}</figcaption></figure>
<h2>Scores</h2>
{tables}
<p class="note">Mean ± standard deviation over the seeds. Each number is taken of one image, over its pixels
with depth, and then averaged over the images of the test. Predictions are clipped to 0.1 … 100 mm. Scaled:
each image’s prediction is multiplied by the one factor that gives it the true median. The best AbsRel is
marked.</p>
{robustness}
<h2>Arms</h2>
<dl>{arms}</dl>
<h2>No leak</h2>
<p>Compared pixel by pixel: {unseen}.</p>
<h2>Datasets</h2>
{commands}
<footer class="note">Made by <code>endotwin study depth</code>. The numbers are in depth.csv, each
run’s own in results/, the trained weights in networks/.</footer>
</body></html>
"""

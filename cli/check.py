"""``endotwin check``: whether poses, intrinsics, depth and photos agree, or the labels of a dataset."""

from __future__ import annotations

import json as json_format
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from endotwin.cli import console

from endotwin.errors import OptionError

if TYPE_CHECKING:
    from endotwin.check import Report
    from endotwin.synth import Proof


def check(
    sequence: Annotated[
        Path,
        typer.Argument(
            metavar="SEQUENCE",
            show_default=False,
            help="Folder (or transforms.json) of a sequence, or of a dataset from 'endotwin synth'.",
        ),
    ],
    format: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="c3vd, transforms, simcol or tum.", show_default="detected"),
    ] = None,
    labels: Annotated[
        bool,
        typer.Option(
            "--labels", help="Prove that the labels of a dataset from 'endotwin synth' agree with each other."
        ),
    ] = False,
    json: Annotated[
        bool, typer.Option("--json", help="Print the findings as JSON instead of a table.")
    ] = False,
    profile: console.Profile = None,
) -> None:
    """Tell whether a SEQUENCE's poses, intrinsics, depth unit and photos agree, and if not, what to change.

    Frames are warped onto each other through depth, as written and under the usual mistakes. Exit code 0: all
    agrees; 1: there is something to mend; 2: the sequence cannot be read. With --labels: flow against depth
    and poses, normals against the gradient of depth, depth against the next frame's, and so on.

    Example: endotwin check examples/colon_small
    """
    if labels and format is not None:
        raise OptionError("a dataset says its own layout; leave --format or --labels out")
    with console.command("check", profile) as run:
        found = _proof(run, sequence) if labels else _report(run, sequence, format)
    if json:
        print(json_format.dumps(found.to_dict()))
    else:
        (_show_proof if labels else _show)(found)
    raise typer.Exit(0 if (found.holds if labels else found.consistent) else 1)


def _report(run: console.Run, sequence: Path, format: str | None) -> Report:
    with run.stage("import"):
        from endotwin.check import check
    with run.stage("check"):
        return check(sequence, format, run.progress)


def _proof(run: console.Run, dataset: Path) -> Proof:
    with run.stage("import"):
        from endotwin.synth import prove
    with run.stage("check"):
        return prove(dataset, progress=run.progress)


def _show_proof(proof: Proof) -> None:
    """A row a claim, and the verdict."""
    from rich.console import Console
    from rich.table import Table

    from endotwin.synth.proof.claims import HEADINGS

    out = Console(highlight=False)
    if proof.rows:
        table = Table(*HEADINGS, box=None, pad_edge=False)
        for row in proof.rows:
            table.add_row(*row.cells())
        out.print(table)
    out.print(f"[bold]{proof.verdict}[/]", soft_wrap=True)


def _show(report: Report) -> None:
    """The measures as a table, then one sentence a finding, and what to change."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    out = Console(highlight=False)
    out.print(escape(report.sequence), soft_wrap=True)
    if report.measures:
        table = Table("measured", "as written", "as best read", box=None, pad_edge=False)
        for row in report.measures:
            table.add_row(*map(escape, row))
        out.print(table)
    out.print(f"[bold]{escape(report.verdict)}[/]", soft_wrap=True)
    for number, finding in enumerate(report.findings, 1):
        out.print(f"{number}. [bold]{finding.kind}[/]: {escape(finding.says)}", soft_wrap=True)
        out.print(f"   → {escape(finding.change)}", soft_wrap=True)
    for note in report.notes:
        out.print(f"note: {escape(note)}", soft_wrap=True)

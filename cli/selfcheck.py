"""``endotwin selfcheck``: does this machine keep what endotwin promises of its numerics?"""

from __future__ import annotations

import json
from typing import Annotated

import typer
from endotwin.cli import console


def selfcheck(
    as_json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")] = False,
    profile: console.Profile = None,
) -> None:
    """Check the numerics on this machine in about a minute: promised bound and measured value of each case.

    Light and BRDF against 40 digits, broken meshes and depth maps, blind cameras, the fit's repeatability.
    Exit code 1 if a bound is broken.

    Example: endotwin selfcheck
    """
    with console.command("selfcheck", profile) as run:
        with run.stage("import"):
            from endotwin.selfcheck import run_checks
        with run.stage("check"):
            findings = list(run_checks(run.progress))
    if as_json:
        print(json.dumps([{"group": group, **finding.to_dict()} for group, finding in findings], indent=1))
    else:
        _print_table(findings)
    broken = sum(not finding.ok for _, finding in findings)
    if broken:
        raise typer.Exit(1)


def _print_table(findings: list) -> None:
    from rich.console import Console
    from rich.table import Table

    from endotwin.selfcheck.finding import shown

    table = Table("case", "bound", "measured", "", title_justify="left", pad_edge=False)
    group = ""
    for title, finding in findings:
        if title != group:
            table.add_section()
            table.add_row(f"[bold]{title}[/bold]")
            group = title
        verdict = "[green]ok[/green]" if finding.ok else "[red]broken[/red]"
        table.add_row(
            finding.case, finding.promise, f"{shown(finding.measured)} {finding.unit}".strip(), verdict
        )
    Console().print(table)
    broken = sum(not finding.ok for _, finding in findings)
    print(f"{len(findings) - broken} of {len(findings)} bounds kept")

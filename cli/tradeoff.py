"""``endotwin tradeoff``: what each second buys, for one's own sequence."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from endotwin.cli import console

from endotwin.errors import OptionError
from endotwin.run.output import TRADEOFF, check_apart, check_free


def tradeoff(
    sequence: Annotated[
        Path,
        typer.Argument(
            metavar="SEQUENCE", show_default=False, help="Folder (or transforms.json) of the sequence."
        ),
    ],
    output: Annotated[
        Path,
        typer.Option("-o", "--output", metavar="DIR", show_default=False, help="Folder for what it finds."),
    ],
    rungs: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES",
            help="Joined by commas: draft, standard, fine, a config file, a knob such as voxel=2, "
            "several of them as draft+steps=0, an effect as gain=on, or endopbr.",
            show_default="the whole ladder",
        ),
    ] = None,
    effects: Annotated[
        str | None,
        typer.Option(
            metavar="RUNG",
            help="Also fit this rung with each effect forced on or off, against what the fit decides.",
            show_default="no effects are compared",
        ),
    ] = None,
    repeats: Annotated[int, typer.Option(metavar="N", help="Runs of each rung; the median counts.")] = 3,
    budget: Annotated[str, typer.Option(metavar="TIME", help="Time for the fit of endopbr.")] = "60s",
    geometry: Annotated[
        str, typer.Option(metavar="known|heldout", help="As for fuse: whose depth may be used.")
    ] = "known",
    overwrite: console.Overwrite = False,
    profile: console.Profile = None,
) -> None:
    """Run a ladder of configs on SEQUENCE and show what each second buys.

    Each rung is the commands fuse, fit and eval in processes of their own, from cold files. DIR gets
    tradeoff.csv, the plot tradeoff.png and .svg, and the page tradeoff.html with the command that
    reproduces each rung. With --effects the page also shows what each effect gains and costs, and DIR gets
    effects.csv, effects.png and .svg. A run that was stopped goes on when the command is run again.

    Example: endotwin tradeoff examples/colon_small -o tradeoff --rungs draft --effects standard --repeats 1
    """
    check_free(output, overwrite, TRADEOFF)
    check_apart(output, [sequence])
    if repeats < 1:
        raise OptionError(f"--repeats is {repeats}, but must be at least 1")
    with console.command("tradeoff", profile) as run:
        with run.stage("import"):
            from endotwin.tradeoff import ladder, tradeoff
            from endotwin.tradeoff.effects import base
            from endotwin.tradeoff.report import table
        chosen, compared = ladder(rungs, budget), effects and base(effects)
        with run.stage("ladder"):
            found = tradeoff(sequence, output, chosen, repeats, geometry, overwrite, run.progress, compared)
    print(table(*found))
    more = ", effects.csv, effects.png and effects.svg" if compared else ""
    print(f"wrote {output}: tradeoff.html, tradeoff.png, tradeoff.svg, tradeoff.csv{more}")

"""``endotwin study``: experiments on what a twin's datasets are worth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from endotwin.cli import console

from endotwin.run.output import STUDY, check_apart, check_free

study = typer.Typer(no_args_is_help=True)


@study.callback()
def describe() -> None:
    """Measure what datasets rendered from a twin are worth.

    Example: endotwin study depth --real cecum_t1_a --twin twin --test sigmoid_t1_a --test trans_t1_a -o study
    """


@study.command("depth")
def depth(
    real: Annotated[
        list[Path],
        typer.Option(metavar="SEQ", show_default=False, help="Sequence to train on; may be repeated."),
    ],
    twin: Annotated[
        list[Path],
        typer.Option(metavar="TWIN", show_default=False, help="Twin to render from; may be repeated."),
    ],
    test: Annotated[
        list[Path],
        typer.Option(
            metavar="SEQ", show_default=False, help="Sequence to test on, that no twin saw; may be repeated."
        ),
    ],
    output: Annotated[
        Path,
        typer.Option("-o", "--output", metavar="DIR", show_default=False, help="Folder for what it finds."),
    ],
    parts: Annotated[
        str,
        typer.Option(
            metavar="NAMES",
            help="Joined by commas: headline (always there), ingredients, curve, robustness; or all.",
        ),
    ] = "headline",
    network: Annotated[
        str,
        typer.Option(
            metavar="small|auto|FOLDER",
            help="A small network; a folder with weights of Depth Anything V2; or those in the cache of "
            "Hugging Face if there are any.",
        ),
    ] = "auto",
    frames: Annotated[int, typer.Option(metavar="N", min=1, help="Frames rendered for each arm.")] = 500,
    steps: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Steps of each training.", show_default="the network's own"),
    ] = None,
    seeds: Annotated[int, typer.Option(metavar="N", min=1, help="Trainings of each arm.")] = 3,
    loss: Annotated[
        str, typer.Option(metavar="huber|silog", help="Huber at 5 mm, or scale-invariant.")
    ] = "huber",
    device: Annotated[str, typer.Option(metavar="cpu|cuda|auto", help="Where networks are trained.")] = "cpu",
    overwrite: console.Overwrite = False,
    profile: console.Profile = None,
) -> None:
    """Train a depth network on real frames, on rendered ones and on both, and test it on other recordings.

    Every arm has the same network, steps and seeds. No photo or depth map of a test may be known to a twin
    or trained on: that is checked. DIR gets the table depth.csv, the plot depth.png and .svg, the page
    depth.html and the trained weights. A run that was stopped goes on when the command is run again.

    Example: endotwin study depth --real cecum_t1_a --twin twin --test sigmoid_t1_a --test trans_t1_a -o study
    """
    check_free(output, overwrite, STUDY)
    check_apart(output, [*real, *twin, *test])
    with console.command("study", profile) as run:
        with run.stage("import"):
            from endotwin.study import Plan, parse_parts, study_depth
            from endotwin.study.report import table
        plan = Plan(parse_parts(parts), network, frames, steps, seeds, loss, device)
        with run.stage("study"):
            findings = study_depth(real, twin, test, output, plan, overwrite, run.progress)
    print(table(findings))
    print(f"wrote {output}: depth.html, depth.png, depth.svg, depth.csv, networks/")

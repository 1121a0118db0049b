"""``endotwin eval``: scores on the held-out photos."""

from __future__ import annotations

import json as json_format
from pathlib import Path
from typing import Annotated

import typer
from endotwin.cli import console

from endotwin.run.output import check_picture


def evaluate(
    twin_folder: console.TwinFolder,
    json: Annotated[
        bool, typer.Option("--json", help="Print the scores as JSON instead of a table.")
    ] = False,
    sheet: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.png", help="Write a picture: photo, render and error of each held-out frame."
        ),
    ] = None,
    scale: Annotated[
        float | None,
        typer.Option(
            metavar="FACTOR",
            help="Compare at this factor of the photos' size, at most 1.",
            show_default="the twin's own",
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the picture of --sheet.")] = False,
    profile: console.Profile = None,
) -> None:
    """Score a fitted TWIN on the frames held out of the fit: every 8th, from the first.

    PSNR, SSIM and, with the extra 'lpips', LPIPS: over the pixels with depth inside the lens circle, and over
    those whose surface a training photo saw ("covered"). The scores are kept in the twin.

    Example: endotwin eval twin --sheet sheet.png
    """
    if sheet is not None:
        check_picture(sheet, overwrite)
    with console.command("eval", profile) as run:
        with run.stage("import"):
            from endotwin.evaluation import evaluate, keep_scores
            from endotwin.twin import Twin
        with run.stage("load"):
            twin = Twin.load(twin_folder)
        with run.stage("eval"):
            scored = twin if scale is None else twin.at_scale(scale)
            evaluation = evaluate(scored, sheet, run.progress, overwrite)
        print(json_format.dumps(evaluation.to_dict()) if json else evaluation)
        with run.stage("write"):
            kept = keep_scores(evaluation.to_dict(), twin, twin_folder)
    written = [f"the scores to {twin_folder}"] * kept + [f"the contact sheet to {sheet}"] * bool(sheet)
    if written and not json:
        print("wrote", " and ".join(written))

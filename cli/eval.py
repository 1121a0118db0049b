"""``endotwin eval``: scores on photos that no fit saw."""

from __future__ import annotations

import json as json_format
from pathlib import Path
from typing import Annotated

import typer
from endotwin.cli import console

from endotwin.errors import OptionError
from endotwin.run.output import check_picture


def evaluate(
    twin_folder: Annotated[
        Path | None,
        typer.Argument(
            metavar="[TWIN]", show_default=False, help="A fitted twin folder; may be left out with --renders."
        ),
    ] = None,
    sequence: Annotated[
        Path | None,
        typer.Option(
            metavar="OTHER",
            help="Score TWIN on all frames of this other recording of the same surface, in the same world "
            "frame; with --renders alone, the sequence that they show.",
            show_default="the twin's own",
        ),
    ] = None,
    renders: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Score another method's pictures of the held-out frames, each named as its photo.",
        ),
    ] = None,
    halves: Annotated[
        bool,
        typer.Option(
            "--halves",
            help="Also score each half of a photo at a pose that was fitted to its other half.",
        ),
    ] = False,
    lpips: Annotated[
        str | None,
        typer.Option(
            metavar="alex|vgg",
            help="The network that LPIPS is of: AlexNet or VGG-16.",
            show_default="alex, where the extra 'lpips' is installed",
        ),
    ] = None,
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
    those whose surface a training photo saw ("covered"). The scores are kept in the twin, but for those of
    --sequence and --renders.

    Example: endotwin eval twin --sheet sheet.png
    Example: endotwin eval --renders theirs --sequence examples/colon_small
    """
    if twin_folder is None and renders is None:
        raise OptionError("nothing is named to be scored; give a TWIN, or --renders with their --sequence")
    if sheet is not None:
        check_picture(sheet, overwrite)
    with console.command("eval", profile) as run:
        with run.stage("import"):
            from endotwin.evaluation import evaluate, keep_scores
            from endotwin.sequence.readers import open_sequence
            from endotwin.twin import Twin
        with run.stage("load"):
            twin = None if twin_folder is None else Twin.load(twin_folder)
            size = 1.0 if scale is None else scale
            other = None if sequence is None else open_sequence(sequence, scale=size)
        with run.stage("eval"):
            own_photos = twin is not None and other is None
            scored = twin.at_scale(scale) if own_photos and scale is not None else twin
            evaluation = evaluate(scored, sheet, run.progress, overwrite, other, renders, halves, lpips)
        print(json_format.dumps(evaluation.to_dict()) if json else evaluation)
        with run.stage("write"):
            own = sequence is None and renders is None
            kept = own and keep_scores(evaluation.to_dict(), twin, twin_folder)
    written = [f"the scores to {twin_folder}"] * kept + [f"the contact sheet to {sheet}"] * bool(sheet)
    if written and not json:
        print("wrote", " and ".join(written))

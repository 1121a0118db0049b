"""``endotwin inspect``: look at a twin."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from endotwin.cli import console

from endotwin.run.output import check_picture


def inspect(
    twin_folder: console.TwinFolder,
    screenshot: Annotated[
        Path | None,
        typer.Option(metavar="FILE.png", help="Draw off-screen into FILE.png instead of opening a window."),
    ] = None,
    map: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Show base_color, roughness, metallic, film, coverage or normals; scope: the view by it.",
            show_default="all",
        ),
    ] = None,
    keyframes: Annotated[
        Path,
        typer.Option(
            metavar="FILE", help="Pose file that the key k adds the view to, for 'synth' spline:FILE."
        ),
    ] = Path("keyframes.txt"),
    overwrite: console.Overwrite = False,
    profile: console.Profile = None,
) -> None:
    """Show TWIN's mesh with its maps and the camera path, and fly a scope through it.

    Keys and sliders are told in the window and in docs/inspector.md.

    Example: endotwin inspect twin --screenshot twin.png --map roughness
    """
    if screenshot is not None:
        check_picture(screenshot, overwrite)
    with console.command("inspect", profile) as run:
        with run.stage("import"):
            from endotwin.look.inspector import inspect
            from endotwin.twin import Twin
        with run.stage("load"):
            twin = Twin.load(twin_folder)
        with run.stage("draw"):
            inspect(twin, screenshot, map, overwrite, keyframes)
    if screenshot is not None:
        print(f"wrote {screenshot}: {map or 'all maps'} of {twin.surface}")

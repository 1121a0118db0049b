"""``endotwin export``: a twin for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from endotwin.cli import console


def export(
    twin_folder: console.TwinFolder,
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            show_default=False,
            help="What to write, by its suffix: .glb, .ply, .obj, .usdz, .html, or .mitsuba (a folder).",
        ),
    ],
    overwrite: console.Overwrite = False,
    profile: console.Profile = None,
) -> None:
    """Write a fitted TWIN for other programs: Blender (.glb), MeshLab (.ply), Mitsuba 3, a browser (.html).

    Example: endotwin export twin colon.glb
    """
    with console.command("export", profile) as run:
        with run.stage("import"):
            from endotwin.export import FORMATS, check_export
            from endotwin.export import export as write
            from endotwin.twin import Twin
        check_export(file, overwrite)
        with run.stage("load"):
            twin = Twin.load(twin_folder)
        with run.stage("write"):
            write(twin, file, overwrite)
    print(f"wrote {file}: {FORMATS[file.suffix.lower()]}")

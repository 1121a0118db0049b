"""``endotwin synth``: a labelled dataset from a twin."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from endotwin.cli import console

from endotwin.output import check_free


def synth(
    twin_folder: console.TwinFolder,
    trajectory: Annotated[
        str,
        typer.Option(
            metavar="SPEC",
            show_default=False,
            help="A pose file (C3VD pose.txt, TUM, transforms.json), 'jitter:…' or 'centerline:…'.",
        ),
    ],
    output: Annotated[
        Path,
        typer.Option("-o", "--output", metavar="DATASET", show_default=False, help="Folder for the dataset."),
    ],
    material: Annotated[
        list[str] | None,
        typer.Option(metavar="EDIT", help="Change a material, such as 'roughness*1.3'; may be repeated."),
    ] = None,
    light: Annotated[
        list[str] | None,
        typer.Option(metavar="EDIT", help="Change the light, such as 'intensity*0.8'; may be repeated."),
    ] = None,
    seed: Annotated[int, typer.Option(metavar="N", help="Seed of all random choices.")] = 0,
    overwrite: console.Overwrite = False,
    profile: console.Profile = None,
) -> None:
    """Render RGB, depth, normals, poses, intrinsics and a validity mask at new poses, in C3VD's layout.

    The same command and seed give the same bytes. endotwin reads the dataset back as a sequence.

    Example: endotwin synth twin --trajectory jitter:frames=100 --material 'roughness*1.3' -o dataset
    """
    check_free(output, overwrite)
    with console.command("synth", profile) as run:
        with run.stage("import"):
            from endotwin.pipeline import synthesize
            from endotwin.twin import Twin
        with run.stage("load"):
            twin = Twin.load(twin_folder)
        with run.stage("synth"):
            summary = synthesize(
                twin,
                trajectory,
                output,
                material=material or (),
                light=light or (),
                seed=seed,
                overwrite=overwrite,
                progress=run.progress,
            )
    print(f"wrote {summary}")

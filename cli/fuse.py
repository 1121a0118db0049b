"""``endotwin fuse``: a sequence becomes a twin's surface."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from endotwin.cli import console

from endotwin.output import check_free


def fuse(
    sequence: Annotated[
        Path,
        typer.Argument(
            metavar="SEQUENCE", show_default=False, help="Folder (or transforms.json) of the sequence."
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "-o", "--output", metavar="TWIN", show_default=False, help="Folder to write the twin to."
        ),
    ],
    format: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="c3vd, transforms, simcol or tum.", show_default="detected"),
    ] = None,
    scale: Annotated[
        float, typer.Option(metavar="FACTOR", help="Work at this factor of the image size.")
    ] = 1.0,
    voxel: Annotated[
        float | None,
        typer.Option(
            metavar="MM", help="Voxel edge in millimetres.", show_default="from the depth footprint"
        ),
    ] = None,
    geometry: Annotated[
        str,
        typer.Option(
            metavar="known|heldout",
            help="known: fuse held-out frames' depth too. heldout: do not. Their photos are never used.",
        ),
    ] = "known",
    overwrite: console.Overwrite = False,
    profile: console.Profile = None,
) -> None:
    """Fuse a sequence's depth maps into a colon mesh: TWIN, whose materials 'endotwin fit' then finds.

    Example: endotwin fuse examples/colon_small -o twin
    """
    check_free(output, overwrite)
    with console.command("fuse", profile) as run:
        with run.stage("import"):
            from endotwin.pipeline import fuse_twin
        with run.stage("fuse"):
            twin = fuse_twin(
                sequence, format=format, scale=scale, geometry=geometry, voxel_mm=voxel, progress=run.progress
            )
        with run.stage("write"):
            twin.save(output, overwrite)
    surface = twin.surface
    seen = (surface.seen_by > 0).mean()
    print(f"wrote {output}: {surface}, {seen:.0%} of the vertices seen by training photos")

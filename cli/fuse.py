"""``endotwin fuse``: a sequence becomes a twin's surface."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer
from endotwin.cli import console

from endotwin.config import DEFAULT, load_config
from endotwin.errors import OptionError
from endotwin.run.output import TWIN, check_free


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
        typer.Option(
            metavar="NAME",
            help="Layout of SEQUENCE: c3vd (pose.txt), transforms (nerfstudio or instant-ngp), simcol "
            "(SimCol3D) or tum (TUM RGB-D).",
            show_default="detected",
        ),
    ] = None,
    config: console.Config = DEFAULT,
    scale: Annotated[
        float | None,
        typer.Option(
            metavar="FACTOR",
            help="Work at this factor of the image size, at most 1.",
            show_default="the config's",
        ),
    ] = None,
    voxel: Annotated[
        float | None,
        typer.Option(
            metavar="MM", help="Voxel edge in millimetres.", show_default="from the depth footprint"
        ),
    ] = None,
    undistort: Annotated[
        str | None,
        typer.Option(
            metavar="WxH",
            help="Resample the frames to a pinhole image, such as 640x480, as published comparisons do.",
            show_default="as photographed",
        ),
    ] = None,
    geometry: Annotated[
        str,
        typer.Option(
            metavar="known|heldout",
            help="Every 8th frame is held out: its photo is never fitted, and 'endotwin eval' scores by it. "
            "known: its depth is fused all the same. heldout: its depth is left out too.",
        ),
    ] = "known",
    overwrite: console.Overwrite = False,
    profile: console.Profile = None,
) -> None:
    """Fuse a sequence's depth maps into a colon mesh: TWIN, whose materials 'endotwin fit' then finds.

    Example: endotwin fuse examples/colon_small -o twin
    """
    check_free(output, overwrite, TWIN)
    plan, size = load_config(config).fuse, None
    if undistort is not None:
        found = re.fullmatch(r"(\d+)[x×](\d+)", undistort)
        if found is None:
            raise OptionError(f"the size '{undistort}' is not understood; write it as 640x480")
        size = int(found[1]), int(found[2])
    with console.command("fuse", profile) as run:
        with run.stage("import"):
            from endotwin.pipeline import fuse_twin
        with run.stage("fuse"):
            twin = fuse_twin(
                sequence,
                format=format,
                scale=scale,
                geometry=geometry,
                voxel_mm=voxel,
                config=plan,
                progress=run.progress,
                undistort=size,
            )
        run.stopwatch.parts["fuse"] = twin.record["fuse"]["stages"]
        with run.stage("write"):
            twin.save(output, overwrite)
    surface = twin.surface
    seen = (surface.seen_by > 0).mean()
    print(f"wrote {output}: {surface}, {seen:.0%} of the vertices seen by training photos")

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
    without: Annotated[
        str | None,
        typer.Option(
            metavar="12,17-19",
            help="Leave these frames, of which the first is 0, out: neither fused nor fitted nor scored by.",
            show_default="none",
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
    plan = load_config(config).fuse
    size = None if undistort is None else _size(undistort)
    left_out = () if without is None else _frames(without)
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
                without=left_out,
            )
        run.stopwatch.parts["fuse"] = twin.record["fuse"]["stages"]
        with run.stage("write"):
            twin.save(output, overwrite)
    surface = twin.surface
    seen = (surface.seen_by > 0).mean()
    print(f"wrote {output}: {surface}, {seen:.0%} of the vertices seen by training photos")


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d+)[x×](\d+)", text)
    if found is None:
        raise OptionError(f"the size '{text}' is not understood; write it as 640x480")
    return int(found[1]), int(found[2])


def _frames(text: str) -> set[int]:
    """Numbers and ranges with both ends, joined by commas."""
    frames = set()
    for part in text.split(","):
        found = re.fullmatch(r"\s*(\d{1,6})\s*(?:[-–]\s*(\d{1,6})\s*)?", part)
        if found is None or int(found[2] or found[1]) < int(found[1]):
            raise OptionError(f"the frames '{text}' are not understood; write them as 12,17-19")
        frames.update(range(int(found[1]), int(found[2] or found[1]) + 1))
    return frames

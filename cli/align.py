"""``endotwin align``: photos registered to the surface."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from endotwin.cli import console

from endotwin.errors import OutputError
from endotwin.run.output import TWIN, check_free, whole_file


def align(
    twin_folder: console.TwinFolder,
    state: Annotated[
        str,
        typer.Option(
            "--align",
            metavar="auto|on|off",
            help="auto: as far as photos that did not choose the corrections bear them out. "
            "on: at least what all photos share. off: back to where the sequence says.",
        ),
    ] = "auto",
    poses: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Write the corrected poses of all frames, in the sequence's own format."
        ),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Write the photos' camera, whose calibration may have been put right."
        ),
    ] = None,
    against: Annotated[
        Path | None,
        typer.Option(metavar="TRAJECTORY", help="Print ATE and RPE against true poses, one a frame."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="OTHER",
            help="Write the aligned twin there.",
            show_default="TWIN itself",
        ),
    ] = None,
    overwrite: console.Overwrite = False,
    profile: console.Profile = None,
) -> None:
    """Align the photos to TWIN's surface, where what is known of registration errors explains them.

    The model's place, the hand-eye matrix, the clock's lag, the calibration, then a drift: each is kept only
    if photos that did not choose it gain. 'endotwin fit' does the same unless told otherwise.

    Example: endotwin align twin --poses corrected.txt
    """
    for path, mark in ((output, TWIN), (poses, None), (camera, None)):
        if path is not None:
            check_free(path, overwrite, mark)
    with console.command("align", profile) as run:
        with run.stage("import"):
            from endotwin.align.trajectory import compare
            from endotwin.align.written import write_poses
            from endotwin.cameras import write_camera
            from endotwin.pipeline import align_twin
            from endotwin.sequence.poses import read_poses
            from endotwin.twin import Twin
        with run.stage("load"):
            twin = Twin.load(twin_folder)
            for path in filter(None, (poses, camera)):
                _check_not_read(path, Path(twin.source.path))
            true = None if against is None else read_poses(against)[0]
        if twin.fitted and output is None and not overwrite:
            raise OutputError(
                f"{twin_folder} is fitted, and to align it would undo that; pass --overwrite, or -o OTHER"
            )
        with run.stage("align"):
            aligned = align_twin(twin, state, progress=run.progress)
        written, sequence = twin.source.open(), aligned.sequence()
        lines = [f"{name}: {value}" for name, value in aligned.record["align"].items() if name != "seconds"]
        if true is not None:
            lines.append(f"as written: {compare(written.T_world_camera, true)}")
            lines.append(f"as aligned: {compare(sequence.T_world_camera, true)}")
        with run.stage("write"):
            aligned.save(output or twin_folder, overwrite=True)
            if poses is not None:
                write_poses(poses, sequence, overwrite)
            if camera is not None:
                with whole_file(camera, overwrite) as file:
                    write_camera(file, aligned.at_scale(1.0).camera)
    print("\n".join(lines))
    print("wrote", " and ".join(map(str, filter(None, (output or twin_folder, poses, camera)))))


def _check_not_read(path: Path, sequence: Path) -> None:
    """Raise OutputError if ``path`` is a file of the sequence, which would then be corrected twice."""
    folder = sequence.parent if sequence.is_file() else sequence
    if path.exists() and path.resolve().is_relative_to(folder.resolve()):
        raise OutputError(
            f"{path} belongs to the sequence {sequence}, which the twin reads again; choose another name"
        )

"""A look at a trajectory before a long run: its poses in the mesh, and a contact sheet of what they see."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from endotwin.look.inspector import Map, Stage, twin_maps
from endotwin.run.output import check_picture
from endotwin.sequence.images import write_png
from endotwin.sequence.spread import spread
from endotwin.synth.encodings import encode_color
from endotwin.synth.job import Job
from endotwin.synth.labels import Labeller
from endotwin.twin import Twin

COLUMNS, ROWS = 4, 3
TILE_PX = 300
FRUSTA = 24
WHITE, BLACK = (255, 255, 255), (0, 0, 0)


def preview(job: Job, out: Path | str, overwrite: bool = False) -> str:
    """Draw the poses of ``job`` in the mesh, above pictures of some frames as they would be rendered.

    Args:
        out: PNG file to write; replaced if it exists and ``overwrite`` is true.

    Returns:
        What was written, in a line.

    Raises:
        OutputError: ``out`` exists, cannot be written, or is not the name of a PNG picture.
    """
    out = Path(out)
    check_picture(out, overwrite)
    sheet = contact_sheet(job)
    poses = job.trajectory.T_world_camera
    tile = (sheet.shape[1], sheet.shape[1] // 2)
    stage = Stage(job.twin, _map_of(job.twin), True, poses, FRUSTA, tile)
    mesh = stage.contact_sheet(list(_map_of(job.twin)), inside=False)
    write_png(out, np.vstack([mesh, sheet]), overwrite)
    counts = job.trajectory.counts
    told = ", ".join(f"{count} {name}" for name, count in counts.items() if name != "asked" and count)
    return f"{out}: {len(poses)} poses{f' ({told})' if told else ''}, {job.trajectory.description}"


def contact_sheet(job: Job) -> np.ndarray:
    """Frames at even distances, small, with their numbers: uint8 [H, W, 3], RGB."""
    small = job.camera.scaled(min(TILE_PX / job.camera.width, 1.0))
    job = replace(job, camera=small, labels=("rgb",), images=("rgb",))
    labeller = Labeller(job)
    blank = np.zeros((small.height, small.width, 3), np.uint8)
    tiles = []
    for index in spread(len(job), COLUMNS * ROWS):
        tile = np.ascontiguousarray(encode_color(labeller.frame(int(index))["rgb"]))
        for color, width in ((BLACK, 3), (WHITE, 1)):
            cv2.putText(tile, str(index), (5, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, color, width, cv2.LINE_AA)
        tiles.append(tile)
    tiles += [blank] * (-len(tiles) % COLUMNS)
    return np.vstack([np.hstack(tiles[k : k + COLUMNS]) for k in range(0, len(tiles), COLUMNS)])


def _map_of(twin: Twin) -> dict[str, Map]:
    """The base colour alone."""
    return {"base_color": twin_maps(twin)["base_color"]}

"""A flat layout with a list of ``image depth`` lines, for fine-tuning metric depth networks."""

from __future__ import annotations

from pathlib import Path

from endotwin.cameras import write_camera
from endotwin.synth.encodings import depth_png
from endotwin.synth.job import Job
from endotwin.synth.layouts.layout import (
    CAMERA_WORDS,
    Layout,
    in_folders,
    needs,
    write_lines,
)

LEVELS_PER_MM = 100


def _tables(folder: Path, job: Job) -> None:
    pairs = [f"{LAYOUT.file(job, i, 'rgb')} {LAYOUT.file(job, i, 'depth')}" for i in range(len(job))]
    write_lines(folder / "filelist.txt", pairs)
    write_camera(folder / "camera.json", job.camera)


LAYOUT = Layout(
    "flat",
    in_folders({"rgb": "images"}),
    _tables,
    {
        "list": "filelist.txt: 'image depth' a line, from the dataset's folder, as Depth Anything V2's "
        "loaders take "
        "them; its VKITTI2 loader divides depth by 100, which gives millimetres here: set --max-depth in mm",
        "poses": "frames.jsonl: T_world_camera, camera to world, mm, camera axes x right, y down, z forward",
        "camera": CAMERA_WORDS,
    },
    {"depth": depth_png(LEVELS_PER_MM, "16-bit z-depth, raw / 100 mm; 0: none")},
    needs("rgb", "depth"),
    reads=False,
)

"""TUM RGB-D (Sturm et al. 2012)."""

from __future__ import annotations

from pathlib import Path

from endotwin.cameras import Pinhole, write_camera
from endotwin.sequence.poses import TIME_DIGITS, write_tum_poses
from endotwin.synth.encodings import depth_png
from endotwin.synth.job import Job
from endotwin.synth.layouts.layout import CAMERA_WORDS, Layout, needs, numbers, write_lines

LEVELS_PER_MM = 5


def _time(job: Job, index: int) -> str:
    return f"{job.trajectory.timestamps_s[index]:.{TIME_DIGITS}f}"


def _place(job: Job, index: int, image: str, suffix: str) -> str:
    return f"{image}/{_time(job, index)}{suffix}"


def _tables(folder: Path, job: Job) -> None:
    for image in ("rgb", "depth"):
        files = [f"{_time(job, index)} {LAYOUT.file(job, index, image)}" for index in range(len(job))]
        write_lines(folder / f"{image}.txt", ["# timestamp filename", *files])
    trajectory = job.trajectory
    times_s = trajectory.timestamps_s.round(TIME_DIGITS)
    write_tum_poses(folder / "groundtruth.txt", trajectory.T_world_camera, times_s)
    write_camera(folder / "camera.json", job.camera)
    if isinstance(job.camera, Pinhole) and not job.camera.distortion.any():
        camera = job.camera
        write_lines(folder / "calibration.txt", [numbers((camera.fx, camera.fy, camera.cx, camera.cy))])


LAYOUT = Layout(
    "tum",
    _place,
    _tables,
    {
        "poses": "groundtruth.txt: camera to world, positions in metres, quaternions x y z w, camera axes x "
        "right, "
        "y down, z forward",
        "lists": "rgb.txt, depth.txt: seconds and file of each image",
        "camera": CAMERA_WORDS + "; calibration.txt: fx fy cx cy, where there is no distortion",
    },
    {"depth": depth_png(LEVELS_PER_MM, "16-bit z-depth, raw / 5000 m (steps of 0.2 mm); 0: none")},
    needs("rgb", "depth"),
    by_time=True,
)

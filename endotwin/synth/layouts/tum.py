"""TUM RGB-D (Sturm et al. 2012)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from endotwin.cameras import Pinhole, write_camera
from endotwin.sequence.poses import MM_PER_UNIT, TIME_DIGITS
from endotwin.synth.encodings import depth_png
from endotwin.synth.job import Job
from endotwin.synth.layouts.layout import CAMERA_WORDS, Layout, needs, numbers, write_lines

LEVELS_PER_MM = 5


def _time(job: Job, index: int) -> str:
    return f"{job.trajectory.timestamps_s[index]:.{TIME_DIGITS}f}"


def _place(job: Job, index: int, image: str, suffix: str) -> str:
    return f"{image}/{_time(job, index)}{suffix}"


def tum_rows(T_world_camera: np.ndarray) -> list[str]:
    """``tx ty tz qx qy qz qw`` of poses [N, 4, 4], positions in metres."""
    quaternions = Rotation.from_matrix(T_world_camera[:, :3, :3]).as_quat(canonical=True)
    positions_m = T_world_camera[:, :3, 3] / MM_PER_UNIT["m"]
    return [numbers(row) for row in np.hstack([positions_m, quaternions])]


def _tables(folder: Path, job: Job) -> None:
    times = [_time(job, index) for index in range(len(job))]
    for image in ("rgb", "depth"):
        files = [f"{time} {LAYOUT.file(job, index, image)}" for index, time in enumerate(times)]
        write_lines(folder / f"{image}.txt", ["# timestamp filename", *files])
    poses = [
        f"{time} {row}" for time, row in zip(times, tum_rows(job.trajectory.T_world_camera), strict=True)
    ]
    write_lines(folder / "groundtruth.txt", ["# timestamp tx ty tz qx qy qz qw", *poses])
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
)

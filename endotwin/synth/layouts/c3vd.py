"""C3VD, versions 1 and 2 (Bobrow et al. 2023)."""

from __future__ import annotations

from pathlib import Path

from endotwin.cameras import write_camera
from endotwin.sequence.poses import write_c3vd_poses
from endotwin.synth.job import Job
from endotwin.synth.layouts.layout import CAMERA_WORDS, Layout, frame_name, in_folders, write_lines

V1_NAMES = {"rgb": "color"}

WORDS = {
    "poses": "pose.txt: a line a frame, the 4x4 camera-to-world matrix column by column (C3VD's order), mm",
    "camera": CAMERA_WORDS,
    "timestamps": "timestamps.txt: seconds, a line a frame",
}


def _tables(folder: Path, job: Job) -> None:
    write_c3vd_poses(folder / "pose.txt", job.trajectory.T_world_camera)
    write_lines(folder / "timestamps.txt", [repr(float(s)) for s in job.trajectory.timestamps_s])
    write_camera(folder / "camera.json", job.camera)


V1 = Layout(
    "c3vd",
    lambda job, index, image, suffix: f"{frame_name(job, index)}_{V1_NAMES.get(image, image)}{suffix}",
    _tables,
    WORDS,
)

V2 = Layout(
    "c3vd2",
    in_folders({"flow": "optical_flow", "occlusion": "occlusions"}),
    _tables,
    WORDS,
)

"""SimCol3D (Rau et al. 2024)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from endotwin.cameras import Pinhole, write_camera
from endotwin.sequence.readers.simcol import DEPTH_FULL, DEPTH_RANGE_MM, MIRROR_Y, MM_PER_CM
from endotwin.synth.encodings import depth_png
from endotwin.synth.job import Job
from endotwin.synth.layouts.layout import (
    CAMERA_WORDS,
    Layout,
    frame_name,
    needs,
    numbers,
    write_lines,
)

FRAMES = "Frames_S1"
NAMES = {"rgb": "FrameBuffer", "depth": "Depth"}


def _place(job: Job, index: int, image: str, suffix: str) -> str:
    return f"{FRAMES}/{NAMES.get(image, image)}_{frame_name(job, index)}{suffix}"


def _tables(folder: Path, job: Job) -> None:
    poses = MIRROR_Y @ job.trajectory.T_world_camera @ MIRROR_Y
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)
    positions_cm = poses[:, :3, 3] / MM_PER_CM
    write_lines(folder / "SavedPosition_S1.txt", [numbers(row) for row in positions_cm])
    write_lines(folder / "SavedRotationQuaternion_S1.txt", [numbers(row) for row in quaternions])
    write_camera(folder / FRAMES / "camera.json", job.camera)
    if isinstance(job.camera, Pinhole) and not job.camera.distortion.any():
        K = job.camera.matrix + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        write_lines(folder / "cam.txt", [numbers(row) for row in K])


LAYOUT = Layout(
    "simcol",
    _place,
    _tables,
    {
        "poses": "SavedPosition_S1.txt (tx ty tz, cm) and SavedRotationQuaternion_S1.txt (qx qy qz qw): "
        "camera to "
        "world, left-handed, y up: mirror y in the world and in the camera for OpenCV's axes",
        "camera": f"{FRAMES}/{CAMERA_WORDS}; cam.txt: the matrix K, principal point counted from the "
        f"image's edge, where there is no distortion",
    },
    {
        "depth": depth_png(
            DEPTH_FULL / DEPTH_RANGE_MM, "16-bit z-depth, raw / 256 / 255 * 20 cm; 0: none; 65280: 20 cm up"
        )
    },
    needs("rgb", "depth"),
    root=FRAMES,
)

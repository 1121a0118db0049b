"""WebDataset: tar files whose members share a key, for training that streams."""

from __future__ import annotations

from pathlib import Path

from endotwin.cameras import write_camera
from endotwin.synth.layouts.layout import CAMERA_WORDS, Layout, frame_name

FRAMES_PER_TAR = 128

LAYOUT = Layout(
    "webdataset",
    lambda job, index, image, suffix: f"{frame_name(job, index)}.{image}{suffix}",
    lambda folder, job: write_camera(Path(folder) / "camera.json", job.camera),
    {
        "tars": f"shard-NNNN.tar, {FRAMES_PER_TAR} frames each: KEY.IMAGE.SUFFIX, and KEY.json with the "
        f"frame's line of "
        "frames.jsonl",
        "poses": "KEY.json: T_world_camera, camera to world, mm, camera axes x right, y down, z forward",
        "camera": CAMERA_WORDS,
    },
    packed=True,
    shard_frames=FRAMES_PER_TAR,
    reads=False,
)

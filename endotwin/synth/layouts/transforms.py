"""``transforms.json`` of nerfstudio and instant-ngp."""

from __future__ import annotations

import json
from pathlib import Path

from endotwin.cameras import Camera, Fisheye, Pinhole
from endotwin.sequence.poses import AXES_OPENGL_OPENCV, MM_PER_UNIT
from endotwin.synth.encodings import depth_png
from endotwin.synth.job import Job
from endotwin.synth.layouts.layout import Layout, in_folders, needs

PATHS = {"depth": ("depth_file_path", "depth_path"), "mask": ("mask_path",)}
"""What frames call their images: nerfstudio, and instant-ngp, which knows no masks."""
LEVELS_PER_MM = 500
DEPTH_SCALE = 1 / LEVELS_PER_MM / MM_PER_UNIT["m"]


def _refusal(camera: Camera, labels: tuple[str, ...]) -> str:
    if isinstance(camera, Fisheye) or (
        isinstance(camera, Pinhole) and not (camera.k4 or camera.k5 or camera.k6)
    ):
        return needs("rgb")(camera, labels)
    return (
        f"a transforms.json cannot describe this {camera.model} camera; choose another layout, or render "
        "through a pinhole or fisheye one"
    )


def _tables(folder: Path, job: Job) -> None:
    camera = job.camera
    distortion = {
        key: getattr(camera, key) for key in ("k1", "k2", "k3", "k4", "p1", "p2") if hasattr(camera, key)
    }
    if isinstance(camera, Pinhole):
        del distortion["k4"]
    frames = []
    for index, pose in enumerate(job.trajectory.T_world_camera @ AXES_OPENGL_OPENCV):
        pose[:3, 3] /= MM_PER_UNIT["m"]
        frame = {"file_path": LAYOUT.file(job, index, "rgb")}
        for image, keys in PATHS.items():
            if image in job.images:
                frame |= dict.fromkeys(keys, LAYOUT.file(job, index, image))
        frames.append({**frame, "transform_matrix": pose.tolist()})
    content = {
        "camera_model": "OPENCV" if isinstance(camera, Pinhole) else "OPENCV_FISHEYE",
        "is_fisheye": isinstance(camera, Fisheye),
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + 0.5,
        "cy": camera.cy + 0.5,
        **distortion,
        "depth_unit_scale_factor": DEPTH_SCALE,
        "integer_depth_scale": DEPTH_SCALE,
        "frames": frames,
    }
    (folder / "transforms.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


LAYOUT = Layout(
    "transforms",
    in_folders({"rgb": "images"}),
    _tables,
    {
        "poses": "transforms.json: camera-to-world matrices, positions in metres, camera axes x right, y "
        "up, z "
        "backward (OpenGL); nerfstudio needs --depth-unit-scale-factor 2e-6, instant-ngp reads "
        "integer_depth_scale and depth_path; mask_path, which instant-ngp passes over: pixels that are 0 are "
        "left out; principal point counted from the image's edge",
        "camera": "transforms.json: OPENCV or OPENCV_FISHEYE intrinsics in pixels; instant-ngp passes over a "
        "pinhole's k3",
    },
    {"depth": depth_png(LEVELS_PER_MM, f"16-bit z-depth, raw / {LEVELS_PER_MM} mm; 0: none")},
    _refusal,
    advice=f"nerfstudio needs --depth-unit-scale-factor {DEPTH_SCALE:g}",
)

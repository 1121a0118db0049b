"""SimCol3D (Rau et al., Medical Image Analysis 2024): synthetic colonoscopy from Unity.

``SCENE/Frames_S1/FrameBuffer_NNNN.png`` and ``Depth_NNNN.png``, 475×475; beside the frames' folder, or
in it, ``SavedPosition_S1.txt`` (tx ty tz in cm), ``SavedRotationQuaternion_S1.txt`` (qx qy qz qw) and
``cam.txt`` (K, nine numbers). Depth in cm is value/256/255·20, and from 20 cm on it is clipped. Poses
are left-handed with y up: mirroring y in the world and in the camera makes both right-handed and the
camera OpenCV's, as in the authors' ``visualize_3D_data.py``. Principal points count from the image's
edge. A ``camera.json`` in the frames' folder overrides ``cam.txt``.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from endotwin.cameras import Camera, Pinhole, camera_from_dict, read_camera
from endotwin.errors import CameraError, SequenceError
from endotwin.sequence.images import read_plane
from endotwin.sequence.poses import FRAMES_PER_SECOND, from_quaternions, numeric_rows
from endotwin.sequence.readers.numbered import numbered_files, paired
from endotwin.sequence.sequence import Sequence

MARK = "FrameBuffer_0000.png"
COLOR, DEPTH = r"FrameBuffer_(\d+)\.png", r"Depth_(\d+)\.png"
DEPTH_RANGE_MM = 200.0
DEPTH_FULL = 256 * 255
MM_PER_CM = 10.0
SIZE = 475
MIRROR_Y = np.diag([1.0, -1.0, 1.0, 1.0])
K_ROW = "9 numbers, the matrix K row by row"


def detects(path: Path) -> bool:
    """Whether ``path`` is a folder with ``FrameBuffer_NNNN.png``."""
    return path.is_dir() and bool(numbered_files(path, COLOR))


def read(path: Path) -> Sequence:
    """The sequence in a folder of frames, at its native size."""
    color = numbered_files(path, COLOR)
    color_files, depth_files = paired(color, numbered_files(path, DEPTH), path)
    return Sequence(
        path=path,
        format="simcol",
        camera=_camera(path),
        T_world_camera=_poses(path),
        color_files=color_files,
        depth_files=depth_files,
        read_depth_mm=read_depth_mm,
        timestamps_s=np.fromiter(color, np.float64) / FRAMES_PER_SECOND,
    )


def read_depth_mm(path: Path) -> np.ndarray:
    """A SimCol3D depth map, float32 [H, W] in mm, NaN where raw 0 or clipped at 200 mm."""
    raw = read_plane(path)
    if raw.dtype != np.uint16:
        raise SequenceError(
            f"{path} holds {raw.dtype}, not the 16 bit of SimCol3D's depth; copy the original file"
        )
    depth_mm = raw.astype(np.float32) * np.float32(DEPTH_RANGE_MM / DEPTH_FULL)
    depth_mm[(raw == 0) | (raw >= DEPTH_FULL)] = np.nan
    return depth_mm


def _camera(path: Path) -> Camera:
    if (path / "camera.json").is_file():
        return read_camera(path / "camera.json")
    file = next((place / "cam.txt" for place in (path, path.parent) if (place / "cam.txt").is_file()), None)
    if file is None:
        return Pinhole(SIZE, SIZE, fx=227.60416, fy=227.60416, cx=SIZE / 2 - 0.5, cy=SIZE / 2 - 0.5)
    words = re.split(r"[,\s]+", file.read_text(encoding="utf-8-sig", errors="replace").strip())
    try:
        K = np.array(words, np.float64).reshape(3, 3)
    except ValueError as error:
        raise CameraError(
            f"{file} is not {K_ROW}; mend it, or put a camera.json beside the frames"
        ) from error
    if not np.isfinite(K).all() or min(K[0, 0], K[1, 1]) <= 0:
        raise CameraError(
            f"{file} has no positive focal lengths; mend it, or put a camera.json beside the frames"
        )
    (fx, _, cx), (_, fy, cy), _ = K.tolist()
    size = {"model": "pinhole", "width": SIZE, "height": SIZE}
    return camera_from_dict({**size, "fx": fx, "fy": fy, "cx": cx - 0.5, "cy": cy - 0.5}, file)


def _poses(path: Path) -> np.ndarray:
    positions_file, quaternions_file = (_pose_file(path, kind) for kind in ("Position", "RotationQuaternion"))
    positions_cm, _ = numeric_rows(positions_file, 3, "'tx ty tz' in cm")
    quaternions, lines = numeric_rows(quaternions_file, 4, "'qx qy qz qw'")
    if len(positions_cm) != len(quaternions):
        raise SequenceError(
            f"{positions_file} has {len(positions_cm)} rows but {quaternions_file.name} has "
            f"{len(quaternions)}; copy the original files"
        )
    poses = from_quaternions(
        positions_cm * MM_PER_CM, quaternions, lambda i: f"{quaternions_file}, line {lines[i]}"
    )
    return MIRROR_Y @ poses @ MIRROR_Y


def _pose_file(path: Path, kind: str) -> Path:
    trajectory = path.resolve().name.removeprefix("Frames_")
    names = [f"Saved{kind}_{trajectory}.txt", f"Saved{kind}.txt"]
    places = [folder / name for folder in (path, path.resolve().parent) for name in names]
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        raise SequenceError(
            f"{path} has no {names[0]} in it or beside it; copy it from the dataset's scene folder"
        )
    return found

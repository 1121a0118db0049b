"""C3VD, versions 1 and 2 (Bobrow et al., Medical Image Analysis 2023), and the datasets that endotwin writes.

v1: ``N_color.png``, ``NNNN_depth.tiff`` and ``pose.txt`` in one folder.
v2: ``rgb/NNNN.png``, ``depth/NNNN.tiff`` and ``pose.txt``.
Depth is 16 bit, 65535 = 100 mm; 0 is none and 65535 clipped, so neither is valid. Floating-point depth (TIFF,
or NPY, NPZ or OpenEXR of the same name) is in mm. A ``camera.json`` in the
folder overrides C3VD's own calibration.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from endotwin.cameras import CALIBRATIONS, read_camera
from endotwin.errors import SequenceError
from endotwin.sequence.floatdepth import in_mm
from endotwin.sequence.images import read_plane
from endotwin.sequence.poses import FRAMES_PER_SECOND, read_c3vd_poses
from endotwin.sequence.readers.numbered import numbered_files, paired
from endotwin.sequence.sequence import Sequence

MARK = "pose.txt"
DEPTH_RANGE_MM = 100.0
COLOR_V1, DEPTH_V1 = r"(\d+)_color\.(?:png|jpe?g|tiff?)", r"(\d+)_depth\.(?:tiff?|png)"
FLOAT_V1, FLOAT_V2 = r"(\d+)_depth(?:_exr)?\.(?:exr|np[yz])", r"(\d+)(?:_depth)?\.(?:exr|np[yz])"
COLOR_V2, DEPTH_V2 = r"(\d+)(?:_color)?\.(?:png|jpe?g|tiff?)", r"(\d+)(?:_depth)?\.(?:tiff?|png)"


def detects(path: Path) -> bool:
    """Whether ``path`` is a folder with C3VD's ``pose.txt`` or file names."""
    if not path.is_dir():
        return False
    return (path / "pose.txt").is_file() or bool(numbered_files(path, COLOR_V1))


def read(path: Path) -> Sequence:
    """The sequence in a folder of either version, at its native size."""
    if (path / "rgb").is_dir():
        version, color = "c3vd-v2", numbered_files(path / "rgb", COLOR_V2)
        depth = _depth_files(path)
    else:
        version, color = "c3vd-v1", numbered_files(path, COLOR_V1)
        depth = numbered_files(path, DEPTH_V1) or numbered_files(path, FLOAT_V1)
    color_files, depth_files = paired(color, depth, path)
    T_world_camera = read_c3vd_poses(path / "pose.txt")
    if len(T_world_camera) > len(color):
        _check_complete(list(color), len(T_world_camera), path)
    calibration = path / "camera.json"
    return Sequence(
        path=path,
        format="c3vd",
        camera=read_camera(calibration) if calibration.is_file() else CALIBRATIONS[version],
        T_world_camera=T_world_camera,
        color_files=color_files,
        depth_files=depth_files,
        read_depth_mm=read_depth_mm,
        timestamps_s=np.fromiter(color, np.float64) / FRAMES_PER_SECOND,
    )


def _depth_files(path: Path) -> dict[int, Path]:
    """Depth maps of version 2 by number; those that are coded, as C3VD's are, before floating-point ones."""
    for name, pattern in (("depth", DEPTH_V2), ("depth", FLOAT_V2), ("depth_exr", FLOAT_V2)):
        if (path / name).is_dir() and (found := numbered_files(path / name, pattern)):
            return found
    return {}


def _check_complete(numbers: list[int], poses: int, path: Path) -> None:
    """Raise SequenceError that names the first number that the frames leave out, if they leave one out."""
    absent = next((n for n in range(numbers[0], numbers[-1]) if n not in numbers), None)
    if absent is not None:
        raise SequenceError(
            f"{path} has {len(numbers)} frames but {poses} poses: there is no photo and depth map of number "
            f"{absent}; add them, or remove its line from pose.txt"
        )


def read_depth_mm(path: Path) -> np.ndarray:
    """A C3VD depth map, float32 [H, W] in mm, NaN where raw 0 or 65535; or one of floating-point mm."""
    raw = read_plane(path)
    if raw.dtype.kind == "f":
        return in_mm(raw, 1.0)
    if raw.dtype != np.uint16:
        raise SequenceError(
            f"{path} holds {raw.dtype}, not the 16 bit of C3VD's depth; write 65535 for 100 mm, or floats "
            "in mm"
        )
    depth_mm = raw.astype(np.float32) * np.float32(DEPTH_RANGE_MM / 65535)
    depth_mm[(raw == 0) | (raw == 65535)] = np.nan
    return depth_mm

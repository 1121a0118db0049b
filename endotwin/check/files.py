"""Which file of a layout holds what, for the sentences that say what to change."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from endotwin.sequence import Sequence


@dataclass(frozen=True)
class Files:
    """Where a layout keeps things, in words.

    Attributes:
        poses, intrinsics, depth: the file, or the files.
        unit: the unit of the pose file.
        axes: the camera axes that the layout asks for.
    """

    poses: str
    intrinsics: str
    depth: str
    unit: str
    axes: str = "OpenCV"


def files_of(sequence: Sequence) -> Files:
    """The files of an opened sequence."""
    folder = Path(sequence.path)
    folder = folder.parent if folder.is_file() else folder
    own = "camera.json" if (folder / "camera.json").is_file() else ""
    depth = "the depth maps"
    if sequence.format == "transforms":
        file = sequence.camera_file
        return Files(file, file, f"{depth} (depth_unit_scale_factor in {file})", "m, or its 'unit'", "OpenGL")
    if sequence.format == "tum":
        return Files("groundtruth.txt", own or "calibration.txt", f"{depth} (5000 = 1 m)", "m")
    if sequence.format == "simcol":
        return Files("SavedPosition and SavedRotationQuaternion", own or "cam.txt", depth, "cm")
    intrinsics = own or "camera.json (there is none: C3VD's own calibration is assumed)"
    return Files("pose.txt", intrinsics, f"{depth} (65535 = 100 mm)", "mm")

"""TUM RGB-D (Sturm et al., IROS 2012): ``rgb.txt``, ``depth.txt``, ``groundtruth.txt`` and what they list.

Each photo is paired with the depth map and the pose nearest in time, within 0.02 s, and left out where
one is missing. Depth is 16 bit, 5000 a metre, 0 for none, or floating point in metres. The format has no
intrinsics, so that the folder needs a ``camera.json``, or a ``calibration.txt`` of 'fx fy cx cy'.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from endotwin.cameras import Camera, camera_from_dict, read_camera
from endotwin.errors import CameraError, SequenceError
from endotwin.sequence.floatdepth import in_mm
from endotwin.sequence.images import read_color, read_plane
from endotwin.sequence.poses import MM_PER_UNIT, numeric_rows, read_text, read_tum_poses
from endotwin.sequence.sequence import Sequence

MARK = "rgb.txt and depth.txt"
MM_PER_LEVEL = 1000 / 5000
NEAR_S = 0.02
LISTS = ("rgb.txt", "depth.txt", "groundtruth.txt")

logger = logging.getLogger("endotwin")


def detects(path: Path) -> bool:
    """Whether ``path`` is a folder with TUM's lists of photos and depth maps."""
    return path.is_dir() and all((path / name).is_file() for name in LISTS[:2])


def read(path: Path) -> Sequence:
    """The sequence in a folder, at its native size."""
    color_s, color_files = _listed(path / "rgb.txt")
    depth_s, depth_files = _listed(path / "depth.txt")
    poses, pose_s = read_tum_poses(path / "groundtruth.txt")
    if not color_files:
        raise SequenceError(f"{path / 'rgb.txt'} lists no frames; name the folder that holds the photos")
    depth, pose = _nearest(color_s, depth_s), _nearest(color_s, pose_s)
    kept = np.flatnonzero((depth >= 0) & (pose >= 0))
    if not len(kept):
        raise SequenceError(
            f"{path} has no photo with a depth map and a pose within {NEAR_S} s; check their timestamps"
        )
    if len(kept) < len(color_files):
        logger.warning(
            "%d of the %d photos of %s have no depth map and pose within %g s and are left out",
            *(len(color_files) - len(kept), len(color_files), path, NEAR_S),
        )
    return Sequence(
        path=path,
        format="tum",
        camera=_camera(path, color_files[kept[0]]),
        T_world_camera=poses[pose[kept]],
        color_files=tuple(color_files[i] for i in kept),
        depth_files=tuple(depth_files[i] for i in depth[kept]),
        read_depth_mm=read_depth_mm,
        timestamps_s=color_s[kept],
    )


def read_depth_mm(path: Path) -> np.ndarray:
    """A TUM depth map, float32 [H, W] in mm, NaN where raw 0; or one of floating-point metres."""
    raw = read_plane(path)
    if raw.dtype.kind == "f":
        return in_mm(raw, MM_PER_UNIT["m"])
    if raw.dtype != np.uint16:
        raise SequenceError(
            f"{path} holds {raw.dtype}, not the 16 bit of TUM's depth; write 5000 for a metre, or floats in "
            "metres"
        )
    depth_mm = raw.astype(np.float32) * np.float32(MM_PER_LEVEL)
    depth_mm[raw == 0] = np.nan
    return depth_mm


def _listed(file: Path) -> tuple[np.ndarray, list[Path]]:
    """Timestamps in seconds [N], ascending, and files of a list of 'timestamp filename'."""
    entries = []
    for number, line in enumerate(read_text(file).splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            time, name = line.split(maxsplit=1)
            entries.append((float(time), file.parent / name.strip()))
        except ValueError as error:
            raise SequenceError(
                f"{file}, line {number}: not a valid row, which is 'timestamp filename'; mend that line"
            ) from error
    entries.sort()
    return np.array([time for time, _ in entries]), [name for _, name in entries]


def _nearest(times: np.ndarray, candidates: np.ndarray) -> np.ndarray:
    """Index int [N] of the candidate nearest to each time, −1 where none is within ``NEAR_S``."""
    if not len(candidates):
        return np.full(len(times), -1)
    order = np.argsort(candidates)
    after = np.clip(np.searchsorted(candidates[order], times), 1, max(len(candidates) - 1, 1))
    pair = np.clip(np.stack([after - 1, after]), 0, len(candidates) - 1)
    gap = np.abs(candidates[order][pair] - times)
    best = gap.argmin(axis=0)
    nearest = order[pair[best, np.arange(len(times))]]
    return np.where(gap.min(axis=0) <= NEAR_S, nearest, -1)


def _camera(path: Path, photo: Path) -> Camera:
    if (path / "camera.json").is_file():
        return read_camera(path / "camera.json")
    calibration = path / "calibration.txt"
    if not calibration.is_file():
        raise CameraError(
            f"{path} has no intrinsics, as TUM's layout holds none; add a camera.json such as "
            '{"model": "pinhole", "width": 640, "height": 480, "fx": 525, "fy": 525, "cx": 319, "cy": 239}'
        )
    rows, _ = numeric_rows(calibration, 4, "'fx fy cx cy'")
    if len(rows) != 1:
        raise CameraError(f"{calibration} has {len(rows)} rows; write one row 'fx fy cx cy'")
    height, width = read_color(photo).shape[:2]
    parameters = dict(zip(("fx", "fy", "cx", "cy"), rows[0].tolist(), strict=True))
    return camera_from_dict({"model": "pinhole", "width": width, "height": height, **parameters}, calibration)

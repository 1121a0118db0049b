"""Opening a sequence that readers refuse for the very mistake that a check is to name."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from endotwin.check.files import files_of
from endotwin.check.findings import Finding
from endotwin.errors import CameraError, SequenceError
from endotwin.sequence import Sequence
from endotwin.sequence.images import read_color, read_plane
from endotwin.sequence.poses import AXES_OPENGL_OPENCV, RIGID_TOLERANCE, is_rigid, poses_as_written, rigid
from endotwin.sequence.readers import FORMATS, open_sequence, transforms


@dataclass(frozen=True)
class Opened:
    """A sequence that can be looked at, and what had to be mended for that.

    Attributes:
        sequence: as read, its poses rigid and one a frame.
        findings: what was wrong.
        calibrated: (width, height) that the calibration is of, where the photos have another size.
    """

    sequence: Sequence
    findings: tuple[Finding, ...] = ()
    calibrated: tuple[int, int] | None = None


def opened(path: Path, format: str | None) -> Opened:
    """Open a sequence however its poses, their number or the size of its calibration are wrong.

    Raises:
        SequenceError, CameraError, OptionError: it cannot be read for another reason; the reader's own error.
    """
    try:
        return Opened(open_sequence(path, format))
    except (SequenceError, CameraError) as error:
        reader = FORMATS.get(format) or next((r for r in FORMATS.values() if r.detects(Path(path))), None)
        if reader is None:
            raise
        try:
            with poses_as_written():
                sequence = reader.read(Path(path))
            sequence, findings = _rigid(sequence)
            sequence, counted = _paired(sequence)
            sequence, sized, calibrated = _sized(sequence)
            sequence.check()
        except (SequenceError, CameraError):
            raise error from None
        return Opened(sequence, (*findings, *counted, *sized), calibrated)


def depth_fault(sequence: Sequence) -> Finding | None:
    """What makes the depth maps useless as a whole: their size, or their unit."""
    files = files_of(sequence)
    depth = sequence.read_depth_mm(sequence.depth_files[0])
    if depth.shape[::-1] != sequence.image_size:
        sizes = "{}×{}".format(*depth.shape[::-1]), "{}×{}".format(*sequence.image_size)
        return Finding(
            "depth_size",
            f"Depth maps are {sizes[0]} but photos are {sizes[1]} pixels.",
            f"Resize the depth maps to {sizes[1]} by nearest neighbour, or the photos and the intrinsics to "
            f"{sizes[0]}.",
            files.depth,
        )
    some = (sequence.read_depth_mm(sequence.depth_files[index]) for index in sequence.spread(5))
    valid = np.mean([np.isfinite(depth_mm).mean() for depth_mm in some])
    raw = read_plane(sequence.depth_files[0])
    full = (raw == 65535).mean() if raw.dtype == np.uint16 else 0.0
    if full > 0.5 and full > valid:
        return Finding(
            "depth_clipped",
            f"{full:.0%} of {sequence.depth_files[0].name} is 65535, the largest value: depth was written in "
            "too fine a unit (or in another one than millimetres) and clipped.",
            f"Write {files.depth} again from the original depth, in the unit that the layout asks for.",
            files.depth,
        )
    if valid < 0.01:
        sequence.require_valid_depth()
    return None


def _rigid(sequence: Sequence) -> tuple[Sequence, list[Finding]]:
    """Poses made rigid; raises SequenceError where no one mistake explains them."""
    T, files = sequence.T_world_camera, files_of(sequence)
    if is_rigid(T).all():
        return sequence, []
    turned, unit_mm = np.eye(4), 1.0
    if sequence.format == "transforms":
        turned, unit_mm = AXES_OPENGL_OPENCV, transforms.pose_unit_mm(Path(sequence.path))
    raw = T @ np.linalg.inv(turned)
    raw[:, :3, 3] /= unit_mm
    transposed = raw.transpose(0, 2, 1) @ turned
    transposed[:, :3, 3] *= unit_mm
    if is_rigid(transposed).all():
        says = "The pose matrices are written transposed (their translation stands in the wrong place)."
        change = f"Transpose every 4×4 matrix in {files.poses}: rows as columns."
        finding = Finding("poses_transposed", says, change, files.poses)
        return replace(sequence, T_world_camera=rigid(transposed, str)), [finding]
    factor = np.cbrt(np.abs(np.linalg.det(T[:, :3, :3])))
    if not np.isfinite(factor).all() or factor.min() < 1e-6:
        raise SequenceError("not rigid")
    scaled = T.copy()
    scaled[:, :3, :3] /= factor[:, None, None]
    mirrored = np.linalg.det(scaled[:, :3, :3]) < 0
    findings = []
    if np.abs(factor - 1).max() > RIGID_TOLERANCE:
        says = f"The rotations are multiplied by {np.median(factor):.4g}: their determinant is not 1."
        change = f"Divide the 3×3 part of every matrix in {files.poses} by the cube root of its determinant."
        findings.append(Finding("poses_scaled", says, change, files.poses))
    if mirrored.all():  # A mirrored world; whether the camera is mirrored too is left to the search.
        scaled = np.diag([1.0, -1.0, 1.0, 1.0]) @ scaled
        says = "The poses are left-handed: their rotations have determinant −1."
        change = f"Mirror one axis of the world in {files.poses}: negate one of the first three rows."
        findings.append(Finding("poses_left_handed", says, change, files.poses))
    return replace(sequence, T_world_camera=rigid(scaled, str)), findings


def _paired(sequence: Sequence) -> tuple[Sequence, list[Finding]]:
    """As many poses as frames: what is too many at the end is left out."""
    frames, poses = len(sequence.color_files), len(sequence.T_world_camera)
    if frames == poses or min(frames, poses) < 3:
        return sequence, []
    count, file = min(frames, poses), files_of(sequence).poses
    change = f"Write one pose a frame into {file}; the first {count} of each were compared."
    finding = Finding("poses_count", f"There are {frames} frames but {poses} poses.", change, file)
    return replace(
        sequence,
        T_world_camera=sequence.T_world_camera[:count],
        color_files=sequence.color_files[:count],
        depth_files=sequence.depth_files[:count],
        timestamps_s=sequence.timestamps_s[:count],
    ), [finding]


def _sized(sequence: Sequence) -> tuple[Sequence, list[Finding], tuple[int, int] | None]:
    """The camera of the photos' size, its numbers left as they are."""
    height, width = read_color(sequence.color_files[0]).shape[:2]
    size = (sequence.camera.width, sequence.camera.height)
    if (width, height) == size:
        return sequence, [], None
    camera = replace(sequence.camera, width=width, height=height)
    file = files_of(sequence).intrinsics
    says = f"The calibration is of {size[0]}×{size[1]} images, but the photos are {width}×{height}."
    finding = Finding("intrinsics_size", says, "", file)
    return replace(sequence, camera=camera, image_size=(width, height)), [finding], size

"""What a reading that differs from the sequence as written says is wrong, and what to change."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np

from endotwin.cameras import Camera
from endotwin.check.files import Files
from endotwin.check.findings import Finding
from endotwin.check.photo import Registration
from endotwin.check.precise import Estimate
from endotwin.check.reading import BASES, IDENTITY, OPENGL, Lens, Reading, principal_point

USUAL_DEPTH_MM = 30.0
"""A typical depth in the colon: of two units that explain a ratio, the one that comes nearer is meant."""
PLAUSIBLE_MM = (0.5, 500.0)
LEAST_SCALE, LEAST_FOCAL, LEAST_CENTRE, LEAST_RAY, LEAST_SHIFT = 0.01, 0.01, 0.25, 0.3, 0.2
"""What is reported at the least: 1 % of scale and focal length, a quarter of a pixel, a fifth of a frame. An
effect must be six times its error as well (the principal point four times)."""
LEVELS_PER_MM = {1.0: "millimetres", 10.0: "tenths of a millimetre", 100.0: "hundredths of a millimetre",
                 256.0: "1/256 mm", 1000.0: "micrometres", 5.0: "TUM's 1/5 mm"}  # fmt: skip
C3VD_LEVELS_PER_MM = 655.35


def settled(reading: Reading, estimate: Estimate, camera: Camera) -> Reading:
    """The reading moved by those numbers of the estimate that are beyond their errors."""
    limits = (0.003, 0.003, 0.003, LEAST_CENTRE, LEAST_CENTRE, 0.1, LEAST_SHIFT)
    step = np.zeros(7)
    for index, least in enumerate(limits):
        if estimate.differs(index, least, 4.0 if index in (3, 4) else 6.0):
            step[index] = estimate.step[index]
    return reading.adjusted(camera, step)


def pose_findings(reading: Reading, files: Files) -> list[Finding]:
    """What is wrong with how the poses are written."""
    inverse = f"Invert every 4×4 matrix in {files.poses}."
    transposed = f"Transpose the 3×3 rotation of every pose in {files.poses}, and keep the translation."
    moved = f"Replace every translation t in {files.poses} by −R t."
    bases = {
        BASES[1]: ("poses_inverted", "The poses are world-to-camera, not camera-to-world.", inverse),
        BASES[2]: (
            "poses_rotation_transposed",
            "The rotations are transposed (world-to-camera), while the translations are camera centres.",
            transposed,
        ),
        BASES[3]: (
            "poses_translation_inverted",
            "The rotations are camera-to-world, but the translations are world-to-camera.",
            moved,
        ),
    }
    findings = []
    if reading.base in bases:
        kind, says, change = bases[reading.base]
        findings.append(Finding(kind, says, change, files.poses))
    if reading.axes == OPENGL:
        written = "OpenCV" if files.axes == "OpenGL" else "OpenGL"
        says = (
            f"The camera axes of the poses are {written}'s, but the layout's are {files.axes}'s (OpenGL: y "
            "up, z backward; OpenCV: y down, z forward)."
        )
        change = f"Negate the second and third column of every camera-to-world matrix in {files.poses}."
        findings.append(Finding("poses_opengl", says, change, files.poses))
    elif reading.axes != IDENTITY:
        findings.append(_axes_finding(reading, files))
    return findings


def _axes_finding(reading: Reading, files: Files) -> Finding:
    axes = np.array(reading.axes)
    columns = [f"{'−' if column.sum() < 0 else '+'}{'xyz'[np.abs(column).argmax()]}" for column in axes.T]
    change = (
        f"Replace the columns x, y, z of every camera-to-world rotation in {files.poses} by "
        f"{', '.join(columns)}."
    )
    if np.linalg.det(axes) < 0:
        says = (
            "The poses are of the other hand than the images: they are left-handed, or the images mirrored."
        )
        return Finding("poses_left_handed", says, change + " Or mirror photos and depth maps.", files.poses)
    says = f"The camera axes of the poses are permuted or turned: they are not {files.axes}'s."
    return Finding("poses_axes", says, change, files.poses)


def unit_findings(scale: float, depth_mm: float, format: str, files: Files) -> list[Finding]:
    """What a factor on the translations, or an impossible depth, says of the units; typical ``depth_mm``."""
    if abs(np.log(scale)) > LEAST_SCALE:
        if abs(np.log(depth_mm / USUAL_DEPTH_MM)) <= abs(np.log(depth_mm / scale / USUAL_DEPTH_MM)):
            return [_pose_unit_finding(scale, depth_mm, files)]
        return [_depth_unit_finding(scale, depth_mm, format, files)]
    if not PLAUSIBLE_MM[0] <= depth_mm <= PLAUSIBLE_MM[1]:
        factor = 10.0 ** np.round(np.log10(USUAL_DEPTH_MM / depth_mm))
        says = (
            f"Depth and translations agree, but the typical depth is {depth_mm:.4g} mm: both are "
            f"{'too large' if factor < 1 else 'too small'} by about {max(factor, 1 / factor):.4g}."
        )
        where = 'Set "unit": "mm" in' if format == "transforms" and factor < 1 else "Rescale depth and"
        change = f"{where} {files.poses}: the layout's unit of translations is {files.unit}."
        return [Finding("unit", says, change, files.poses)]
    return []


def _pose_unit_finding(scale: float, depth_mm: float, files: Files) -> Finding:
    says = f"The translations of the poses are {1 / scale:.4g} times what the depth maps say."
    if abs(np.log10(scale) - np.round(np.log10(scale))) < 0.01:
        says += f" They are in another unit than {files.unit}."
    change = (
        f"Multiply every translation in {files.poses} by {scale:.4g} (or, if the poses are right, the depth "
        f"by {1 / scale:.4g}: it is typically {depth_mm:.3g} mm now)."
    )
    return Finding("pose_unit", says, change, files.poses)


def _depth_unit_finding(scale: float, depth_mm: float, format: str, files: Files) -> Finding:
    says = f"The depth maps are {scale:.4g} times what the poses say (typically {depth_mm:.3g} mm)."
    if format == "c3vd":
        levels = C3VD_LEVELS_PER_MM * scale
        near = min(LEVELS_PER_MM, key=lambda known: abs(np.log(levels / known)))
        if abs(np.log(levels / near)) < 0.03:
            says += f" They hold {LEVELS_PER_MM[near]}, while 65535 stands for 100 mm in this layout."
    if format != "transforms":
        change = f"Multiply the depth by {1 / scale:.5g} and write it again: {files.depth}."
    else:
        change = (
            f"Multiply depth_unit_scale_factor in {files.poses} by {1 / scale:.5g}; where the file has none, "
            "it is 0.001, and 1 for OpenEXR."
        )
    return Finding("depth_unit", says, change, files.depth)


def lens_findings(
    lens: Lens, estimate: Estimate, camera: Camera, files: Files, of_size: Finding | None
) -> list[Finding]:
    """What is wrong with the intrinsics, from where image pixels lie in the calibration."""
    mirrored = np.array(lens.scale) < 0
    focal = 1 / np.abs(lens.scale)
    centre, calibrated = lens.image(principal_point(camera)), principal_point(camera)
    last = np.array([camera.width - 1.0, camera.height - 1.0])
    centre = np.where(mirrored, last - centre, centre)
    numbers = _numbers(camera, focal, centre)
    findings = []
    if of_size is not None:
        file = of_size.file
        change = f"Write the photos' size and {numbers} into {file}."
        return [Finding(of_size.kind, of_size.says, change, file)]
    if np.abs(np.log(focal)).max() > max(LEAST_FOCAL, 6 * estimate.error[1:3].max()):
        resized = Lens.of_resized(*focal).image(calibrated)
        off_resized, off_kept = np.linalg.norm(centre - resized), np.linalg.norm(centre - calibrated)
        ratio = f"{focal[0]:.4g}" if np.ptp(focal) < 0.005 * focal[0] else f"{focal[0]:.4g} × {focal[1]:.4g}"
        change = f"Set {numbers} in {files.intrinsics}."
        if off_resized < off_kept:
            size = " × ".join(f"{round(n / f)}" for n, f in zip(last + 1, focal, strict=True))
            says = (
                f"The intrinsics are of another resolution: these images are {ratio} times the size of the "
                f"calibrated ones, which were about {size} pixels."
            )
            findings.append(Finding("intrinsics_scale", says, change, files.intrinsics))
        else:
            says = f"The focal length should be {ratio} times what is written."
            findings.append(Finding("focal_length", says, change, files.intrinsics))
    elif np.abs(centre - calibrated).max() > LEAST_CENTRE:
        off = calibrated - centre
        says = f"The principal point is written {off[0]:+.2f}, {off[1]:+.2f} px off"
        if np.abs(np.abs(off) - 0.5).max() < 0.2:
            says += ": half a pixel, as when pixel centres are counted from the image's corner"
        findings.append(
            Finding("principal_point", says + ".", f"Set {numbers} in {files.intrinsics}.", files.intrinsics)
        )
    return findings


def _numbers(camera: Camera, focal: np.ndarray, centre: np.ndarray) -> str:
    """The intrinsics to write, in the camera's own names; to half a per mille and a tenth of a pixel."""
    written = asdict(camera)
    if "fx" in written:
        lengths = f"fx {written['fx'] * focal[0]:.2f}, fy {written['fy'] * focal[1]:.2f}, "
    elif np.abs(np.log(focal)).max() > 0.003:
        lengths = f"a camera scaled by {focal[0]:.4g} × {focal[1]:.4g}, "
    else:
        lengths = ""
    return f"{lengths}cx {centre[0]:.1f}, cy {centre[1]:.1f} (pixel centres at whole numbers)"


def other_findings(reading: Reading, registration: Registration | None, files: Files) -> list[Finding]:
    """Mirrored images, frames that are paired wrongly, and distances along rays."""
    flip, lag = ("none", 0) if registration is None else (registration.flip, registration.shift)
    mirrored = min(reading.lens.scale) < 0
    shift = reading.shift if abs(reading.shift) > LEAST_SHIFT else 0.0
    findings = []
    if reading.ray > LEAST_RAY:
        says = "Depth is the distance along each pixel's ray, not z-depth."
        change = f"Multiply each pixel of {files.depth} by the z of its unit ray."
        findings.append(Finding("depth_along_ray", says, change, files.depth))
    if reading.order != "listed":
        how = {
            "reversed": "in reverse",
            "alphabetic": "in the alphabetic order of unpadded numbers (0, 1, 10, …)",
        }[reading.order]
        change = f"Sort the rows of {files.poses} into the order of the frames."
        findings.append(Finding("poses_order", f"The poses are written {how}.", change, files.poses))
    if mirrored and flip != "none":
        says = f"The depth maps are mirrored ({flip}): photos and poses agree, depth does not."
        findings.append(Finding("depth_mirrored", says, "Mirror the depth maps back.", files.depth))
    elif mirrored:
        across = "left to right" if reading.lens.scale[0] < 0 else "top to bottom"
        says = f"Photos and depth maps are mirrored {across}, or the poses are left-handed."
        change = f"Mirror photos and depth maps back, or negate the camera's axis in {files.poses}."
        findings.append(Finding("images_mirrored", says, change, "photos and depth maps"))
    elif flip != "none":
        says = f"The photos are mirrored {flip} against their depth maps."
        findings.append(Finding("photos_mirrored", says, "Mirror the photos back.", "photos"))
    if lag and shift and abs(shift - lag) < 0.5:
        says = f"Depth map i belongs to photo and pose i{lag:+d}."
        change = f"Renumber the depth maps by {lag:+d}."
        findings.append(Finding("depth_shifted", says, change, files.depth))
        return findings
    if shift:
        says = f"The poses are mis-timed: frame i has the pose of row i{shift:+.2g}."
        change = f"Move the rows of {files.poses} by {-shift:+.2g} frames, and drop frames without a pose."
        findings.append(Finding("poses_shifted", says, change, files.poses))
    if lag:
        says = f"The photos are mis-timed: depth map and pose i belong to photo i{lag:+d}."
        findings.append(Finding("photos_shifted", says, f"Renumber the photos by {-lag:+d}.", "photos"))
    return findings


def offset_finding(registration: Registration) -> list[Finding]:
    """Photos that lie beside their depth maps, or show something else."""
    if registration.unrelated:
        says = (
            "The photos do not show what the depth maps show: their shading correlates by "
            f"{registration.best:.2f} only, whatever the frame, and up to 4 % of the image aside."
        )
        change = "Take the photos of this sequence, neither cropped nor undistorted otherwise than the depth."
        return [Finding("photos_unrelated", says, change, "photos")]
    if not registration.judged:
        return []
    if not registration.off_centre:
        return []
    u, v = registration.offset
    says = f"The photos lie {u:+.1f}, {v:+.1f} px (right, down) beside their depth maps."
    change = "Move the photos back by that, or render depth for the photos' own intrinsics."
    return [Finding("photos_offset", says, change, "photos")]

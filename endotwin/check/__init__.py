"""Whether poses, intrinsics, depth unit and photos of a sequence agree, and if not, what to change.

Frames are warped onto each other through their depth, as the files are written and under the usual mistakes;
where the points of one frame land on the depth measured in another, the reading is right. Photos are judged
against the shading that their depth maps predict, which no exposure or gain disturbs. Frames pass by one by
one to find those that are repeated, blurred, mis-timed or misregistered.

What can be told, on sequences with and without 1 % of white depth noise: the way poses are written, units
and ray depth always where the camera moves; scale and focal lengths to 1 %; the principal point to a quarter
of a pixel where the camera turns or advances enough (the error is estimated, and nothing within four errors
is reported); photos against depth maps to 0.7 px; a single frame's pose to 0.3 % of its depth. A left-handed
pose file and mirrored images are the same thing to geometry; so are a factor on translations and its
inverse on depth, of which the one that gives a depth usual in the colon is named.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from endotwin.check.diagnosis import (
    lens_findings,
    offset_finding,
    other_findings,
    pose_findings,
    settled,
    unit_findings,
)
from endotwin.check.files import Files, files_of
from endotwin.check.findings import KINDS, Finding, Report
from endotwin.check.frames import frame_findings
from endotwin.check.opening import Opened, depth_fault, opened
from endotwin.check.photo import Registration, registration
from endotwin.check.precise import Estimate, estimate
from endotwin.check.processing import processing
from endotwin.check.reading import OPENGL, Lens, Reading
from endotwin.check.search import Candidate, Found, best_reading
from endotwin.check.views import Views, read_views
from endotwin.check.warp import disagreement
from endotwin.run.jsontext import parsed
from endotwin.run.output import DATASET
from endotwin.sequence.poses import AXES_OPENGL_OPENCV

__all__ = ["KINDS", "Finding", "Report", "check"]

AGREES = 2e-4
"""Median residual in ln z that needs no search, beside three times the noise."""
DISAGREES = 0.01
"""Median residual that nothing explains, or four times the noise."""

Progress = Callable[[str, int, int], None]


def check(path: Path | str, format: str | None = None, progress: Progress | None = None) -> Report:
    """Check a sequence, or a dataset in the layout of one.

    Args:
        path: its folder, or its ``transforms.json``.
        format: one of ``endotwin.sequence.readers.FORMATS``; detected unless given.

    Raises:
        SequenceError, CameraError, OptionError: it cannot be read, for a reason that no reading mends.
    """
    opening = opened(Path(path), format)
    sequence = opening.sequence
    fault = depth_fault(sequence)
    if fault is not None:
        return Report(repr(sequence), (*opening.findings, fault), (), ())
    files, start = files_of(sequence), Reading()
    written = sequence.T_world_camera
    if files.axes == "OpenGL":
        written, start = written @ AXES_OPENGL_OPENCV, Reading(layout=OPENGL)
    views = read_views(sequence, written)
    if len(sequence) < 2 or len(views.depth) < 1000:
        note = "There are too few frames, or too little depth, to compare frames with each other."
        return Report(repr(sequence), opening.findings, (note,), ())
    if (moving := _moving(Path(path))) is not None:
        return Report(repr(sequence), opening.findings, (moving,), ())
    found, fine = _judged(views, start, opening.calibrated)
    reading = settled(found.reading, fine, sequence.camera)
    final = disagreement(views, reading)
    agrees = final.median < max(DISAGREES, 4 * views.left) and final.lands > 0.05
    photos = registration(sequence, views.frames)
    findings = _findings(opening, reading, fine, views, photos, files)
    if not agrees:
        still = (written == written[0]).all()
        findings.append(_still(files) if still else _disagreement(final.median, final.lands, files))
    in_place = photos.judged and photos.flip == "none" and photos.shift == 0
    frames, notes = frame_findings(sequence, written, reading, files.poses, agrees, in_place, progress)
    notes = [*_limits(views, reading, fine, photos), *notes, *processing(sequence)]
    return Report(
        repr(sequence),
        (*findings, *frames),
        tuple(notes),
        _measures(views, found, final.median, fine, photos),
    )


def _moving(path: Path) -> str | None:
    """A note that tissue moves by itself, which a dataset of endotwin's says; None where it does not."""
    for folder in (path, path.parent):
        try:
            motion = parsed((folder / DATASET).read_text(encoding="utf-8")).get("motion")
        except (OSError, ValueError, AttributeError):
            continue
        if motion:
            return (
                "The tissue moves by itself, so that no frame shows the surface of another: poses, "
                "intrinsics and depth are not judged; '--labels' judges the labels of each frame."
            )
    return None


def _judged(views: Views, start: Reading, calibrated: tuple[int, int] | None) -> tuple[Found, Estimate]:
    """The best reading, and how precisely its numbers are known."""
    forced = () if calibrated is None else _resized(views, start, calibrated)
    found = best_reading(views, start, 3 * views.left + AGREES, forced)
    return found, estimate(views, found.reading)


def _resized(views: Views, start: Reading, calibrated: tuple[int, int]) -> tuple[Candidate, ...]:
    """What images of another size than the ``calibrated`` one may be: resized, cropped, or misdescribed."""
    camera = views.sequence.camera
    size = np.array([camera.width, camera.height], float)
    ratio = size / calibrated
    cropped = Lens(offset=tuple(((np.array(calibrated) - size) / 2).tolist()))
    lenses = [Lens.of_resized(*ratio), Lens.of_resized(*np.full(2, ratio.max())), cropped, Lens()]
    return tuple(Candidate("lens", replace(start, lens=lens)) for lens in lenses)


def _findings(
    opening: Opened, reading: Reading, fine: Estimate, views: Views, photos: Registration, files: Files
) -> list[Finding]:
    camera, sequence = views.sequence.camera, views.sequence
    of_size = next((f for f in opening.findings if f.kind == "intrinsics_size"), None)
    mirrored = min(reading.lens.scale) < 0 or np.linalg.det(reading.axes) < 0
    return [
        *(
            f
            for f in opening.findings
            if f is not of_size and not (f.kind == "poses_left_handed" and mirrored)
        ),
        *pose_findings(reading, files),
        *unit_findings(reading.scale, views.typical_depth_mm, sequence.format, files),
        *lens_findings(reading.lens, fine, camera, files, of_size),
        *other_findings(reading, photos if photos.judged else None, files),
        *offset_finding(photos),
    ]


def _still(files: Files) -> Finding:
    says = "All poses are the same, while the depth maps show that the camera moves."
    return Finding("poses_still", says, f"Write the pose of each frame into {files.poses}.", files.poses)


def _disagreement(median: float, lands: float, files: Files) -> Finding:
    amount = f"by {median:.1%} of their depth" if lands > 0.05 else "wholly: points land nowhere"
    says = f"Frames disagree {amount} even under the best reading: no one usual mistake explains it."
    change = (
        f"Check {files.poses} (are they poses of these frames, precise enough?), the camera model and its "
        f"distortion in {files.intrinsics}, and whether depth is metric."
    )
    return Finding("disagreement", says, change, files.poses)


def _limits(views: Views, reading: Reading, fine: Estimate, photos: Registration) -> list[str]:
    """What this sequence cannot tell."""
    notes = []
    now = disagreement(views, reading)
    still = disagreement(views, replace(reading, scale=reading.scale * 1e-6))
    if now.median < DISAGREES and still.median < 2 * max(now.median, views.left):
        notes.append(
            "The camera hardly moves for the noise of its depth: poses and their unit cannot be judged here."
        )
    if fine.error[3:5].max() * 4 > 0.5:
        notes.append(
            f"Half a pixel of the principal point cannot be told here (±{fine.error[3:5].max():.1f} px)."
        )
    if np.isnan(photos.best):
        notes.append("The pictures are too small for photos to be held against depth maps.")
    elif not photos.judged and not photos.unrelated:
        notes.append(
            f"Photos hardly correlate with the shading of their depth maps ({photos.best:.2f}): their "
            "registration was not judged."
        )
    elif photos.judged and not np.isfinite(photos.offset).all():
        notes.append("There are too few rims of folds to place photos on depth maps to a pixel.")
    return notes


def _measures(
    views: Views, found: Found, median: float, fine: Estimate, photos: Registration
) -> tuple[tuple[str, str, str], ...]:
    error, step = fine.error, fine.step
    best = "" if found.before.median == median else f"{median:.2e}"
    return (
        ("depth noise, relative", f"{views.noise:.2e}", ""),
        ("median disagreement of depth, relative", f"{found.before.median:.2e}", best),
        ("… in units of the noise", f"{found.before.median / (0.6745 * max(views.left, 1e-9)):.1f}", ""),
        ("points that land on depth", f"{found.before.lands:.0%}", f"{found.after.lands:.0%}"),
        ("translation scale left", "", f"{np.exp(step[0]):.4f} ± {error[0]:.4f}"),
        ("focal length left", "", f"{np.exp(step[1:3].mean()):.4f} ± {error[1:3].max():.4f}"),
        ("principal point left, px", "", f"{step[3]:+.2f}, {step[4]:+.2f} ± {error[3:5].max():.2f}"),
        ("poses late by, frames", "", f"{step[6]:+.3f} ± {error[6]:.3f}"),
        ("photo and shading correlate", f"{photos.correlation:.2f}", f"{photos.best:.2f}"),
        (
            "photo beside depth, px",
            f"{photos.offset[0]:+.2f}, {photos.offset[1]:+.2f} ± {np.max(photos.error):.2f}"
            if np.isfinite(photos.offset).all()
            else "not measured",
            "",
        ),
    )

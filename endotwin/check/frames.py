"""Single frames that are repeated, blurred, mis-timed or misregistered, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.ndimage import median_filter

from endotwin.check.depths import prepared
from endotwin.check.findings import Finding
from endotwin.check.photo import correlation
from endotwin.check.reading import Reading
from endotwin.check.stream import LEAST_DEPTH, Shot, Step, misfit_of, pair_of, shots_and_steps
from endotwin.robust import robust_std
from endotwin.sequence import Sequence

LEAST_MISFIT = 0.003
"""Relative displacement of the surface from which a pose counts as wrong: .06 mm at 20 mm."""
OUTLIER = 8.0
STILL_PX = 0.05
SAME_LEVEL = 0.15  # of 255, the mean difference of block means of one photo stored twice
LEAST_BLUR = 0.35  # drop of ln(fine detail / coarse detail) against the neighbours
TRIED_SHIFTS = (1, -1, 2, -2, 3, -3, 4, -4, 5, -5)
MOST_NAMED = 40


def frame_findings(
    sequence: Sequence,
    written: np.ndarray,
    reading: Reading,
    poses_file: str,
    judge_poses: bool,
    judge_photos: bool,
    progress: Callable[[str, int, int], None] | None = None,
) -> tuple[list[Finding], list[str]]:
    """Findings that concern single frames, and notes."""
    shots, steps, empty = [], [], []
    for index, (shot, step) in enumerate(shots_and_steps(sequence, written, reading)):
        shots.append((shot.sharpness, correlation(shot.photo, shot.shading)))
        if np.isfinite(shot.inverse).sum() < LEAST_DEPTH:
            empty.append(sequence.depth_files[index].name)
        steps += [step] * (step is not None)
        if progress:
            progress("check frames", index + 1, len(sequence))
    sharpness, match = np.array(shots).T
    names = [file.name for file in sequence.color_files]
    findings, notes = _repeated(names, steps)
    if empty:
        notes.append(f"{_listed(empty)}: hardly any usable depth.")
    told = {name for finding in findings for name in finding.frames}
    if judge_poses and len(sequence) > 3:
        findings += _moved(sequence, written, reading, steps, names, poses_file, told)
        told |= {name for finding in findings for name in finding.frames}
    if judge_photos and len(sequence) > 3:
        findings += _strange_photos(names, steps, match, told)
    findings += _faulty(names, sharpness)
    return findings, notes


def _repeated(names: list[str], steps: list[Step]) -> tuple[list[Finding], list[str]]:
    """Frames that are stored twice, and a note of those between which nothing moves."""
    groups: dict[str, list[str]] = {}
    still = []
    for step in steps:
        name = names[step.index]
        stands = step.motion_px < STILL_PX
        near = step.same_photo or (step.change < SAME_LEVEL and step.motion_px > 1)
        if step.same_photo and step.same_depth and (step.same_pose or stands):
            groups.setdefault("photo, depth and pose repeat the frame before (it is static)", []).append(name)
        elif near and step.same_depth:
            groups.setdefault("photo and depth repeat the frame before while the pose moves", []).append(name)
        elif near and not stands:
            groups.setdefault("the photo repeats the frame before while the camera moves", []).append(name)
        elif step.same_depth and not stands:
            what = "the depth map repeats the frame before while the camera moves"
            groups.setdefault(what, []).append(name)
        elif stands and step.change < 1:
            still.append(name)
    change = "Remove these frames, with their poses, or restore the original files."
    findings = [
        Finding("duplicate", f"{_listed(some)}: {what}.", change, "the frames named", tuple(some))
        for what, some in groups.items()
    ]
    notes = []
    if still:
        notes.append(f"static: the camera stands still at {_listed(still)}; such frames add nothing new.")
    return findings, notes


def _moved(
    sequence: Sequence,
    written: np.ndarray,
    reading: Reading,
    steps: list[Step],
    names: list[str],
    poses_file: str,
    told: set[str],
) -> list[Finding]:
    """Frames whose pose and depth fit neither neighbour."""
    misfit = np.array([step.misfit for step in steps])
    limit = max(LEAST_MISFIT, OUTLIER * float(np.nanmedian(misfit)))
    bad = misfit > limit
    left, right = np.append(True, bad), np.append(bad, True)  # of each frame: the step to it, and from it
    at_ends = np.array([not bad[1], *[False] * (len(bad) - 1), not bad[-2]])
    wrong = left & right
    wrong[[0, -1]] &= at_ends[[0, -1]]
    wrong = [index for index in np.flatnonzero(wrong) if names[index] not in told]
    if not wrong:
        return []
    groups: dict[tuple[str, str], list[str]] = {}
    for index in wrong[:MOST_NAMED]:
        source = _nearest_good(index, set(wrong), len(sequence))
        shift = _fitting_shift(sequence, written, reading, source, index, limit) if source is not None else 0
        if np.array_equal(written[index], written[index - 1]) and index:
            key = ("mistimed", "the pose repeats that of the frame before while the depth moves")
        elif shift:
            key = (
                "mistimed",
                f"depth and photo fit the pose of the frame {abs(shift)} "
                f"{'later' if shift > 0 else 'earlier'}",
            )
        else:
            key = ("misregistered", "pose and depth agree with neither neighbour")
        groups.setdefault(key, []).append(names[index])
    change = f"Give these frames their own pose in {poses_file} and their own depth map, or remove them."
    return [
        Finding(kind, f"{_listed(some)}: {what}.", change, poses_file, tuple(some))
        for (kind, what), some in groups.items()
    ]


def _nearest_good(index: int, wrong: set[int], count: int) -> int | None:
    others = [k for k in range(max(index - 3, 0), min(index + 4, count)) if k not in wrong]
    return min(others, key=lambda k: abs(k - index), default=None)


def _fitting_shift(
    sequence: Sequence, written: np.ndarray, reading: Reading, source: int, index: int, limit: float
) -> int:
    """By how many frames the pose of ``index`` must move to fit ``source``; 0 where none helps."""
    cosine = sequence.camera.pixel_directions[..., 2]
    blank = Shot(0, *[np.empty(0, np.float32)] * 4, 0.0, 0, 0)
    shots = [
        replace(blank, index=k, inverse=prepared(sequence.depth_mm(k), cosine).inverse)
        for k in (source, index)
    ]
    best, least = 0, limit
    for shift in TRIED_SHIFTS:
        if 0 <= index + shift < len(written):
            moved = written.copy()
            moved[index] = written[index + shift]
            misfit = misfit_of(pair_of(sequence, moved, *shots), reading)[1]
            if misfit < least:
                best, least = shift, misfit
    return best


def _strange_photos(names: list[str], steps: list[Step], match: np.ndarray, told: set[str]) -> list[Finding]:
    """Frames whose photo fits a neighbour's depth better than its own, or none at all."""
    usual = float(np.nanmedian(match))
    spread = robust_std((match - usual)[np.isfinite(match)])
    of_other = np.full(len(match), -1.0)
    for step in steps:
        of_other[step.index] = max(of_other[step.index], np.nan_to_num(step.after, nan=-1))
        of_other[step.index - 1] = max(of_other[step.index - 1], np.nan_to_num(step.before, nan=-1))
    advantage = of_other - match
    mistimed = (advantage > 0.1) & (match < usual - max(0.1, 4 * spread))
    strange = (match < usual - max(0.3, 8 * spread)) & ~mistimed
    findings = []
    for kind, which, what in (
        ("mistimed", mistimed, "the photo fits the depth map of a neighbouring frame better than its own"),
        ("misregistered", strange, "the photo does not show what its depth map shows"),
    ):
        some = [names[index] for index in np.flatnonzero(which) if names[index] not in told]
        if some:
            change = "Restore the photo or depth map of these frames, or remove them with their poses."
            findings.append(Finding(kind, f"{_listed(some)}: {what}.", change, "photos", tuple(some)))
    return findings


def _faulty(names: list[str], sharpness: np.ndarray) -> list[Finding]:
    """Frames whose photos show nothing, or far less fine detail than those around them."""
    if len(sharpness) < 5:
        return []
    blank = ~np.isfinite(sharpness)
    finite = np.where(blank, -10.0, sharpness)
    drop = median_filter(finite, size=min(15, len(finite) // 2 * 2 - 1), mode="reflect") - finite
    spread = robust_std(drop - np.median(drop))
    blurred = ~blank & (drop > max(LEAST_BLUR, 8 * spread))
    findings = []
    for kind, which, what in (
        ("blank", blank, "nothing is to be seen in them"),
        ("blurred", blurred, "far less sharp than the frames around (blurred or out of focus)"),
    ):
        if which.any():
            index = np.flatnonzero(which)
            some = [names[each] for each in index]
            change = f"Leave these frames out: 'endotwin fuse --without {','.join(map(str, index))}'."
            findings.append(Finding(kind, f"{_listed(some)}: {what}.", change, "photos", tuple(some)))
    return findings


def _listed(names: list[str], most: int = 8) -> str:
    shown = ", ".join(names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"

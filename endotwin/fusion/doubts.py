"""What depth maps and poses say against one another, told as warnings: a mesh is made all the same."""

from __future__ import annotations

import logging

import numpy as np
from scipy.spatial import cKDTree

from endotwin.sequence import Sequence

NOISE_MOST = 0.04
"""Depth that one can fuse scatters less than this share of the distance about a common surface."""

STRAY_DEPTHS = 5.0
"""A camera so many median distances away from the next one sees nothing of what that one sees."""

CONTRADICTED, AGREED = 0.5, 0.7
"""A frame is at fault if less of it agrees with the surface than this, while more of the median one does."""

logger = logging.getLogger("endotwin")


def without_strays(sequence: Sequence, frames: list[int], median_mm: float) -> list[int]:
    """``frames`` but for those, told as warnings, whose cameras lie beyond what any other sees, where
    ``median_mm`` is the usual distance seen; all of them where most lie so."""
    if len(frames) < 2:
        return frames
    positions_mm = sequence.T_world_camera[frames, :3, 3]
    gap_mm = cKDTree(positions_mm).query(positions_mm, k=2)[0][:, 1]
    stray = np.flatnonzero(gap_mm > STRAY_DEPTHS * median_mm)
    if len(stray) > len(frames) / 2:
        logger.warning(
            "the cameras of %s are %.3g mm apart but see only %.3g mm far: poses and depth seem to differ "
            "in their unit; %s",
            *(sequence.path, np.median(gap_mm), median_mm, _remedy(sequence)),
        )
        return frames
    for index in stray:
        logger.warning(
            "the camera of %s is %.3g mm from any other, and left out of the surface; check its pose",
            *(sequence.color_files[frames[index]], gap_mm[index]),
        )
    return np.delete(frames, stray).tolist()


def doubt_scatter(sequence: Sequence, noise: float) -> None:
    """Warn where depth scatters by the share ``noise`` of the distance, more than noise does."""
    if noise > NOISE_MOST:
        logger.warning(
            "the depth maps of %s disagree by %.0f %% of the distance: the poses (their direction, axes or "
            "unit), the intrinsics or the depth's unit seem to be wrong; %s",
            *(sequence.path, 100 * noise, _remedy(sequence)),
        )


def doubt_frames(sequence: Sequence, agreeing: dict[int, float]) -> None:
    """Warn of single frames that the others contradict; ``agreeing`` is the share of each that does not."""
    if agreeing and np.median(list(agreeing.values())) > AGREED:
        for index in (index for index, share in agreeing.items() if share < CONTRADICTED):
            name = sequence.depth_files[index]
            logger.warning("%s contradicts the other frames; check it and its pose", name)


def _remedy(sequence: Sequence) -> str:
    return f"'endotwin check {sequence.path}' tells which"

"""What depth maps and poses say against one another, told as warnings: a mesh is made all the same."""

from __future__ import annotations

import logging

import numpy as np
from scipy.spatial import cKDTree

from endotwin.fusion.mesh import joined
from endotwin.sequence import Sequence

NOISE_MOST = 0.04
"""Depth that one can fuse scatters less than this share of the distance about a common surface."""

STRAY_DEPTHS = 5.0
"""A camera so many median distances away from the next one sees nothing of what that one sees."""

STRAY_SHARE = 0.25
"""More frames that lie together, beyond what the others see, are another part of the recording."""

CONTRADICTED, AGREED = 0.5, 0.7
"""A frame is at fault if less of it agrees with the surface than this, while more of the median one does."""

logger = logging.getLogger("endotwin")


def without_strays(sequence: Sequence, frames: list[int], median_mm: float) -> list[int]:
    """``frames`` but for those, told as warnings, whose cameras lie beyond what the others see, where
    ``median_mm`` is the usual distance seen: alone, or in groups of at most STRAY_SHARE of all. All of them
    where that would leave less than half."""
    positions_mm = sequence.T_world_camera[frames, :3, 3]
    cells, cell = np.unique(np.floor(positions_mm / (STRAY_DEPTHS * median_mm)), axis=0, return_inverse=True)
    beside = cKDTree(cells).query_pairs(1.0, p=np.inf, output_type="ndarray")
    group = joined(len(cells), beside)[cell.reshape(-1)]
    lost = np.bincount(group)[group] <= max(STRAY_SHARE * len(frames), 1)
    stray = np.flatnonzero(lost)
    if len(frames) < 2 or not len(stray):
        return frames
    if len(stray) > len(frames) / 2:
        gap_mm = np.median(cKDTree(positions_mm).query(positions_mm, k=2)[0][:, 1])
        logger.warning(
            "the cameras of %s are %.3g mm apart but see only %.3g mm far: poses and depth seem to differ "
            "in their unit; %s",
            *(sequence.path, gap_mm, median_mm, _remedy(sequence)),
        )
        return frames
    others = cKDTree(positions_mm[~lost])
    for index in stray:
        logger.warning(
            "the camera of %s is %.3g mm from the others, and left out of the surface; check its pose",
            *(sequence.color_files[frames[index]], others.query(positions_mm[index])[0]),
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

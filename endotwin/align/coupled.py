"""Normal equations of frames that see the same places, each of which has a level that nobody knows."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

CHUNK = 2000
"""Places whose sightings are multiplied at a time."""


def coupled(
    slopes: np.ndarray,
    residual: np.ndarray,
    weight: np.ndarray,
    frame: np.ndarray,
    place: np.ndarray,
    counts: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray]:
    """Matrix [F, K, F, K] and right-hand side [F, K] of K unknowns of each frame, the places' own levels
    eliminated (Schur complement).

    Args:
        slopes: [N, K], of a sighting's value by its frame's unknowns. residual: [N], without its place's
            weighted mean. weight: [N]. frame: int [N], ascending. place: int [N], each once a frame. counts:
            F, and how many places there are.
    """
    weighted = slopes * weight[:, None]
    (count, places), width = counts, slopes.shape[1]
    own = np.zeros((count, width, width))
    right = np.stack([-np.bincount(frame, x * residual, count) for x in weighted.T], axis=1)
    bounds = np.searchsorted(frame, np.arange(count + 1))
    for number, (start, stop) in enumerate(pairwise(bounds)):
        own[number] = weighted[start:stop].T @ slopes[start:stop]
    full = np.zeros((count, width, count, width))
    full[np.arange(count), :, np.arange(count)] = own
    full = full.reshape(width * count, width * count)
    total = np.bincount(place, weight, places)
    order = np.argsort(place, kind="stable")
    starts = np.arange(0, places, CHUNK)
    edges = np.searchsorted(place[order], np.r_[starts, places])
    for start, low, high in zip(starts, edges[:-1], edges[1:], strict=True):
        rows = order[low:high]
        sums = np.zeros((min(CHUNK, places - start), count, width))
        sums[place[rows] - start, frame[rows]] = weighted[rows]
        sums /= np.sqrt(np.maximum(total[start : start + CHUNK], 1e-9))[:, None, None]
        flat = sums.reshape(len(sums), -1)
        full -= flat.T @ flat
    return full.reshape(count, width, count, width), right

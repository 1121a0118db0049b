"""Which frames are compared with which, and the points that are warped between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from endotwin.check.depths import prepared
from endotwin.run.ahead import ahead
from endotwin.run.threads import THREADS
from endotwin.sequence import Sequence

GROUPS, GROUP = 4, 6
"""Frames come in groups of neighbours, spaced 0, 1, … up to ``REACH`` frames: 24 in all."""
REACH = 60
WIDEST_DEG = 30.0
SAMPLES = 100_000


@dataclass(frozen=True)
class Views:
    """The frames that a check looks at closely, and sample points of ordered pairs of them.

    Attributes:
        sequence: where they come from.
        written: poses as the files have them, float64 [N, 4, 4]; the translation in mm.
        frames: their places in the sequence, int [F].
        inverse: 1/z float32 [F, H, W], NaN where it cannot be judged.
        noise, left: relative depth noise as measured, and as left after smoothing.
        source, target: index into ``frames`` of each sample, int [S].
        pixel: pixel [S, 2] and depth: z-depth [S] in the source, as stored.
        pair: number of the ordered pair, int [S], of ``ends`` [P, 2].
    """

    sequence: Sequence
    written: np.ndarray
    frames: np.ndarray
    inverse: np.ndarray
    noise: float
    left: float
    source: np.ndarray
    target: np.ndarray
    pixel: np.ndarray
    depth: np.ndarray
    pair: np.ndarray
    ends: np.ndarray

    @property
    def typical_depth_mm(self) -> float:
        """Median z-depth of the samples."""
        return float(np.median(self.depth)) if len(self.depth) else np.nan


def read_views(sequence: Sequence, written: np.ndarray, seed: int = 0) -> Views:
    """Read the depth of a few groups of frames, the same for the same ``seed``.

    Memory is that of ``GROUPS · GROUP`` depth maps, however long the sequence.
    """
    groups = chosen_groups(written)
    frames = np.unique(np.concatenate(groups))
    cosine = sequence.camera.pixel_directions[..., 2]
    maps = list(ahead(lambda frame: prepared(sequence.depth_mm(frame), cosine), frames, THREADS))
    inverse = np.stack([depth.inverse for depth in maps])
    place = {frame: index for index, frame in enumerate(frames.tolist())}
    ends = [
        (place[a], place[b])
        for group in groups
        for a in group.tolist()
        for b in group.tolist()
        if a != b and _angle_deg(written[a], written[b]) < WIDEST_DEG
    ]
    ends = np.unique(np.array(ends, int).reshape(-1, 2), axis=0)
    pixel, depth, pair = sampled(inverse, ends, SAMPLES // max(len(ends), 1), np.random.default_rng(seed))
    return Views(
        sequence=sequence,
        written=written,
        frames=frames,
        inverse=inverse,
        noise=float(np.median([depth.noise for depth in maps])),
        left=float(np.median([depth.left for depth in maps])),
        source=ends[pair, 0],
        target=ends[pair, 1],
        pixel=pixel,
        depth=depth,
        pair=pair,
        ends=ends,
    )


def sampled(
    inverse: np.ndarray, ends: np.ndarray, each: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels [S, 2], their depths [S], and pair numbers [S]: ``each`` known pixels of every pair's first
    view."""
    usable = [np.flatnonzero(np.isfinite(layer)) for layer in inverse]
    picks = [usable[a][rng.integers(0, len(usable[a]), min(each, len(usable[a])))] for a, _ in ends]
    pair = np.repeat(np.arange(len(ends)), [len(pick) for pick in picks])
    v, u = np.divmod(np.concatenate([*picks, np.empty(0, int)]).astype(int), inverse.shape[2])
    return (
        np.stack([u, v], axis=1).astype(np.float64),
        1 / inverse[ends[pair, 0], v, u].astype(np.float64),
        pair,
    )


def chosen_groups(written: np.ndarray) -> list[np.ndarray]:
    """Groups of frames, each within ``WIDEST_DEG`` of its first; the turn between two poses is the same under
    every way to read them."""
    count = len(written)
    if count <= GROUP:
        return [np.arange(count)]
    reach = min(max(count // 2, GROUP), REACH, count - 1)
    anchors = np.unique(np.linspace(0, count - 1 - reach, min(GROUPS, count - reach)).round().astype(int))
    groups = []
    for anchor in anchors:
        wide = [
            step
            for step in range(1, reach + 1)
            if _angle_deg(written[anchor], written[anchor + step]) > WIDEST_DEG
        ]
        farthest = max(wide[0] - 1, GROUP - 1) if wide else reach
        steps = np.unique(np.geomspace(1, farthest, GROUP - 1).round().astype(int))
        groups.append(anchor + np.concatenate([[0], steps]))
    return groups


def _angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    turn = a[:3, :3].T @ b[:3, :3]
    return float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))

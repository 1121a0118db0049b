"""Interlacing: a frame's odd rows are half a frame younger than its even ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy.special import stdtrit
from torch import Tensor

from endotwin.effects.effect import Effect
from endotwin.effects.exposure import Shot
from endotwin.effects.luma import LUMA
from endotwin.sequence import Sequence
from endotwin.sequence.images import unclipped

FIELDS = (-0.25, 0.25)
"""When the even and the odd rows are exposed, in frame intervals from the labelled pose."""

FRAMES = 32
"""Photos, spread over a sequence, that are searched for combs."""

TILE_ROWS, TILE_COLUMNS = 16, 2
"""Of a tile, each of whose rows is averaged: a comb is wider than the noise of a pixel."""

MARGIN_PX = 9
"""Off the lens's edge, which no camera's motion moves."""

STRONGEST = 0.005
"""Share of the tiles, those with the most fine detail, in which combs would be."""

CHANCE = 1e-6
"""Greatest probability of a comb that is none."""

_ROW = np.arange(TILE_ROWS)
_HANN = np.sin(np.pi * _ROW / TILE_ROWS) ** 2
ALTERNATING = _HANN * np.cos(np.pi * _ROW)
SLOWER = np.sqrt(2) * _HANN * np.cos(0.625 * np.pi * _ROW)
"""Detail that changes sign from row to row, and at five eighths of that frequency: each of the same power in
white noise."""

BASIS = np.stack([ALTERNATING, SLOWER, _HANN, np.gradient(_HANN)], axis=1)

ROUNDED = np.sqrt(4 / 3)
"""Rounding normal values to multiples of any step, as codecs do, raises their deviation no more: by the root
of 1.333 at a step of 2.33 deviations."""


@dataclass(frozen=True)
class Interlacing(Effect):
    """Two fields a frame, of every other row each (ITU-R BT.601, top field first), woven together: what moves
    has combed edges. Each field passes the lens as a whole picture of its own. Depth, normals and poses are
    those of the labelled pose, which lies between the fields.
    """

    name: ClassVar[str] = "interlacing"

    def woven(self, seen: Callable[[Shot], Tensor], shot: Shot) -> Tensor:
        """Radiance float32 [H, W, 3] of a shot whose pictures are as ``seen``."""
        even, odd = (seen(shifted(shot, time)) for time in FIELDS)
        even = even.clone()
        even[1::2] = odd[1::2]
        return even

    @classmethod
    def evidence(cls, sequence: Sequence) -> tuple[Interlacing | None, str]:
        """Combs: the finest detail alternates from row to row more often than it varies a little slower.

        Lenses and noise let no spectrum rise towards its end, and what a processor sharpens it sharpens
        across the rows as well as along them: combs must be beyond both an even chance and the columns'
        share, by Student's t of the frames' scatter, or of a coin's if that is more. A still camera has none.
        """
        chosen = sequence.spread(FRAMES)
        lit = sequence.well_lit(MARGIN_PX)
        across, along = zip(*(_details(sequence.color(index), lit) for index in chosen), strict=True)
        (rows, rows_error, tiles), (columns, columns_error, _) = _share(across), _share(along)
        told = f"{rows:.0%} of the finest detail alternates by rows, {columns:.0%} by columns"
        rows_error = max(rows_error, 0.5 / np.sqrt(tiles))
        least = stdtrit(len(chosen) - 1, 1 - CHANCE) * np.hypot(rows_error, columns_error)
        if len(chosen) > 1 and rows - max(0.5, columns) > least:
            return cls(), f"the photos are combed: {told}"
        return None, f"rendered on request: the photos show no two fields of different moments ({told})"


def _details(photo: np.ndarray, lit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the unclipped tiles of a photo uint8 [H, W, 3], and of the transposed photo: [N, 4] with what is
    ALTERNATING, what is SLOWER, the mean and the slope."""
    luma = photo @ LUMA
    usable = lit & unclipped(photo)
    return _of_tiles(luma, usable), _of_tiles(luma.T, usable.T)


def _of_tiles(luma: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Of luminance [H, W], in its usable tiles."""
    down, across = luma.shape[0] // TILE_ROWS, luma.shape[1] // TILE_COLUMNS

    def columns(image: np.ndarray) -> list[np.ndarray]:
        """Those of all tiles, one after the other, each [down, TILE_ROWS, across]."""
        whole = image[: down * TILE_ROWS, : across * TILE_COLUMNS]
        return [whole[:, k::TILE_COLUMNS].reshape(down, TILE_ROWS, across) for k in range(TILE_COLUMNS)]

    chosen = np.all(columns(usable), axis=0).all(axis=1)
    return np.mean(columns(luma), axis=0).swapaxes(1, 2)[chosen] @ BASIS


def _share(frames: tuple[np.ndarray, ...]) -> tuple[float, float, int]:
    """Share of the strongest tiles of all frames that alternate more than they vary slower, its standard
    error by the frames' scatter, and how many tiles they are; (0, 0, 1) where there is none.

    Even and odd rows that differ in offset or gain, or lie closer in pairs, alternate without a motion: what
    is proportional to a tile's mean or slope is taken out first, by least squares.
    """
    number = np.repeat(np.arange(len(frames)), [len(tiles) for tiles in frames])
    alternating, slower, mean, slope = np.concatenate(frames).T
    if len(mean) == 0:
        return 0.0, 0.0, 1
    fixed = np.stack([np.ones(len(mean)), mean, slope], axis=1)
    alternating = (alternating - fixed @ np.linalg.lstsq(fixed, alternating)[0]) / ROUNDED
    strongest = np.argsort(alternating**2 + slower**2)[-max(round(STRONGEST * len(mean)), 1) :]
    wins = (np.abs(alternating) > np.abs(slower))[strongest]
    count = np.bincount(number[strongest], minlength=len(frames))
    won = np.bincount(number[strongest], wins, len(frames))
    share = won.sum() / count.sum()
    scatter = np.sqrt(np.sum((won - share * count) ** 2) * len(frames) / max(len(frames) - 1, 1))
    return float(share), float(scatter / count.sum()), int(count.sum())


def shifted(shot: Shot, time: float) -> Shot:
    """The shot whose labelled pose is that of ``time``, with the same velocity."""
    return replace(shot, T_world_camera=shot.pose(time), T_world_next=shot.pose(time + 1))

"""Which frames are worth fusing: those that see what no other saw, or not from as near, or from another side.

Frames of a video lie tenths of a millimetre apart, so that most of them add nothing to a surface. Each depth
map is looked at once, coarsely. What it sees is a set of (place, direction, distance); frames are taken
greedily, the one that adds most first, until the best of the rest adds little. Those that are left out are
still asked what they say of the surface: where one disagrees, it is fused after all.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from endotwin.cameras import Camera
from endotwin.fusion.agreement import Tolerance
from endotwin.fusion.faces import distance_mm
from endotwin.fusion.views import warn_skipped
from endotwin.run.ahead import ahead
from endotwin.run.threads import THREADS
from endotwin.sequence import Sequence
from endotwin.surface.casting import Caster

STRIDE = 4
"""A glance has every fourth pixel of every fourth row."""

WORTH_PIXELS = 64 * 640 * 480
"""Of fewer pixels in all, every frame is fused: that takes seconds."""

CELL_PX = 24
"""Edge of a place, in pixels at the median distance."""

DIRECTIONS = 2.0
"""A component of a viewing direction is rounded to so many parts of one: bins of about 30°."""

LEAST_NEW = 0.012
"""A frame is left out where it adds less than this share of what a frame sees."""

LACKING_PX = 6
"""Edge of a place that lacks a surface, in pixels at the median distance."""

LEAST_LACKING = 2
"""A frame is patched from where it shows at least so many such places that no other does."""

PATCHED_FRAMES = 3.0
"""At most so many frames are patched from besides those that were fused, in shares of these: nearly any large
one shows a strip of a pixel that no other does, and takes a quarter of a second."""


@dataclass(frozen=True)
class Glance:
    """One depth map at every ``STRIDE``-th pixel.

    Attributes:
        index: position in the sequence. T_world_camera: float64 [4, 4].
        distance_mm: float32 [h, w], along the rays; NaN where nothing was measured.
    """

    index: int
    T_world_camera: np.ndarray
    distance_mm: np.ndarray


def glances(sequence: Sequence, frames: Iterable[int]) -> list[Glance]:
    """A glance at each of ``frames``; those that measured nothing are left out, and named in the log."""

    def glance(index: int) -> Glance:
        distances_mm = distance_mm(sequence.camera, sequence.depth_mm(index))
        return Glance(index, sequence.T_world_camera[index], distances_mm[::STRIDE, ::STRIDE].copy())

    found = []
    for seen in ahead(glance, frames, THREADS):
        if np.isfinite(seen.distance_mm).any():
            found.append(seen)
        else:
            warn_skipped(sequence, seen.index)
    return found


def chosen(camera: Camera, seen: list[Glance], fold: int = 1) -> list[int]:
    """Indices, ascending, of frames that see each place ``fold`` times, or as often as it is seen at all."""
    cell_mm = CELL_PX * _pixel_mm(camera, seen)
    directions = camera.pixel_directions[::STRIDE, ::STRIDE]
    sights = [_sights(glance, directions, cell_mm) for glance in seen]
    least = LEAST_NEW * np.median([len(each) for each in sights])
    return sorted(seen[number].index for number in cover(sights, least, fold))


def cover(sights: list[np.ndarray], least: float, fold: int = 1) -> list[int]:
    """Numbers of those of the sets ``sights`` (int64 [K] each) that hold all elements ``fold`` times, taken
    greedily, that which adds most first, until the best of the rest adds fewer than ``least``."""
    keys, compact = np.unique(np.concatenate(sights), return_inverse=True)
    sights = np.split(compact.reshape(-1), np.cumsum([len(each) for each in sights])[:-1])
    wanted = np.full(len(keys), fold)
    waiting = [(-len(each), number) for number, each in enumerate(sights)]
    heapq.heapify(waiting)
    taken = []
    while waiting:
        _, number = heapq.heappop(waiting)
        new = int((wanted[sights[number]] > 0).sum())
        if waiting and new < -waiting[0][0]:  # another may add more by now
            heapq.heappush(waiting, (-new, number))
            continue
        if new < max(least, 1):
            break
        wanted[sights[number]] -= 1
        taken.append(number)
    return taken


def _pixel_mm(camera: Camera, seen: list[Glance]) -> float:
    """What a pixel spans at the median distance."""
    median_mm = float(np.median([np.nanmedian(glance.distance_mm) for glance in seen]))
    return median_mm * float(np.nanmedian(np.linalg.norm(np.diff(camera.pixel_directions, axis=1), axis=-1)))


def _sights(glance: Glance, directions: np.ndarray, cell_mm: float) -> np.ndarray:
    """What a glance sees, as unique int64 [K]: a place, from a direction, within a power of two of distance.

    Whoever sees from near also sees what is seen from farther.
    """
    use = np.isfinite(glance.distance_mm) & np.isfinite(directions).all(axis=-1)
    distances_mm = glance.distance_mm[use].astype(np.float64)
    rays = directions[use] @ glance.T_world_camera[:3, :3].T
    place = _places(glance.T_world_camera[:3, 3] + rays * distances_mm[:, None], cell_mm)
    bins = np.rint(rays * DIRECTIONS).astype(np.int64) + int(DIRECTIONS)
    width = 2 * int(DIRECTIONS) + 1
    towards = (bins[:, 0] * width + bins[:, 1]) * width + bins[:, 2]
    octave = np.clip(np.floor(np.log2(np.maximum(distances_mm / cell_mm, 1))).astype(np.int64), 0, 15)
    key = np.unique((place * width**3 + towards) * 16 + octave)
    farther = [key[key % 16 + more < 16] + more for more in range(4)]
    return np.unique(np.concatenate(farther))


def _places(points_mm: np.ndarray, cell_mm: float) -> np.ndarray:
    """A number of the cell in which each of points [N, 3] lies, int64 [N]; few cells share one."""
    x, y, z = np.floor(points_mm / cell_mm).astype(np.int64).T
    return x * 73_856_093 ^ y * 19_349_663 ^ z * 83_492_791


def compared(
    camera: Camera, caster: Caster, seen: list[Glance], tolerance: Tolerance
) -> tuple[dict[int, float], dict[int, np.ndarray]]:
    """By frame the share of the measured pixels of its glance at which the caster's surface lies; and the
    places, int64 [K], at which it lacks a surface or is hidden by one."""
    cell_mm = LACKING_PX * _pixel_mm(camera, seen)

    def against(glance: Glance) -> tuple[int, float, np.ndarray]:
        mask = np.zeros((camera.height, camera.width), bool)
        mask[::STRIDE, ::STRIDE] = np.isfinite(glance.distance_mm)
        differs = mask.copy().reshape(-1)
        hits = caster.cast(camera, glance.T_world_camera, mask)
        row, column = np.divmod(hits.pixel, camera.width)
        measured_mm = glance.distance_mm[row // STRIDE, column // STRIDE]
        differs[hits.pixel[np.abs(hits.distance_mm - measured_mm) <= tolerance.at(measured_mm)]] = False
        pixel = np.flatnonzero(differs)
        row, column = np.divmod(pixel, camera.width)
        rays = camera.pixel_directions[row, column] @ glance.T_world_camera[:3, :3].T
        points_mm = rays * glance.distance_mm[row // STRIDE, column // STRIDE, None]
        places = np.unique(_places(points_mm + glance.T_world_camera[:3, 3], cell_mm))
        return glance.index, 1 - len(pixel) / mask.sum(), places

    found = list(ahead(against, seen))
    return {index: share for index, share, _ in found}, {index: places for index, _, places in found}


def differing(places: dict[int, np.ndarray], fused: list[int]) -> list[int]:
    """Frames, which tells most first, in which the surface differs at places where no fused frame says so."""
    others = sorted(set(places) - set(fused))
    if not others:
        return []
    known = np.concatenate([places[index] for index in fused])
    sights = [np.setdiff1d(places[index], known) for index in others]
    most = round(PATCHED_FRAMES * len(fused))
    return [others[number] for number in cover(sights, LEAST_LACKING)[:most]]

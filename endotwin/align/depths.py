"""Depth maps that move with their photos: where they disagree with the surface that they were fused to, their
poses are wrong, whatever the photos show.

Point-to-plane registration of every frame to the surface of all (Chen & Medioni 1992), which is fused again.
The surface goes where its depth maps go: all are solved for at once, the level of every place eliminated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from endotwin.align.corrections import Corrections, pose_precision
from endotwin.align.coupled import coupled
from endotwin.align.motion import moved
from endotwin.config import FuseConfig
from endotwin.pixels.length_unit import unit_mm
from endotwin.robust import robust_std
from endotwin.run.ahead import ahead
from endotwin.run.threads import THREADS
from endotwin.sequence import Sequence
from endotwin.sequence.spread import spread
from endotwin.surface import Surface
from endotwin.surface.casting import Caster
from endotwin.surface.cells import numbered
from endotwin.surface.vectors import dot, unit
from endotwin.twin import Twin

PIXELS = 6000
GRAZING = 0.15
"""Least cosine between normal and ray of a pixel that tells where it is."""

FARTHEST = 0.1
"""Depth that differs by a larger share of it shows another surface."""

HUBER = 2.0
ALIKE = 20.0
"""What is wrong with surface and depth errs alike in so many pixels."""

ROUNDS, STEPS = 2, 3
"""Of fusing, and of steps on each surface."""

CELL_MM = 2.0
"""Places that have a level of their own: small beside what a depth map sees, large beside its pixels."""

TOGETHER = 200
"""So many depth maps, evenly spread, are brought next to each other at once."""

LEAST_POINTS = 100
"""A depth map that meets the surface in fewer does not move by itself."""

_PRIOR = pose_precision()

COARSER = 2.0
"""Surfaces but the last are fused at so much larger voxels."""

MIN_GAIN_DB = 2.0
"""Depth maps move where that lowers their disagreement by so much."""

GLANCE_FRAMES = 12


@dataclass(frozen=True)
class _Beside:
    """Points of a depth map beside a surface, P of them.

    Attributes:
        points_mm: [P, 3], of the surface. distance_mm: [P], along its normals. slopes: [P, 6], of that by the
            camera's twist. weight: [P], in units of the robust ``width_mm``.
    """

    points_mm: np.ndarray
    distance_mm: np.ndarray
    slopes: np.ndarray
    weight: np.ndarray
    width_mm: float

    @classmethod
    def of(cls, caster: Caster, sequence: Sequence, pose: np.ndarray, frame: int) -> _Beside:
        depth_mm = sequence.depth_mm(frame)
        known = np.flatnonzero(np.isfinite(depth_mm))
        drawn = np.random.default_rng(frame).choice(known, min(PIXELS, len(known)), replace=False)
        chosen = np.zeros(depth_mm.size, bool)
        chosen[drawn] = True
        hits = caster.cast(sequence.camera, pose, chosen.reshape(depth_mm.shape))
        rays = sequence.camera.pixel_directions.reshape(-1, 3)[hits.pixel].astype(np.float64)
        measured = rays * (depth_mm.reshape(-1)[hits.pixel] / rays[:, 2])[:, None]
        normals = hits.interpolate(caster.surface, caster.surface.normals).astype(np.float64)
        normals = unit(normals @ pose[:3, :3])
        met = rays * hits.distance_mm[:, None]
        near = np.abs(dot(measured - met, rays)) < FARTHEST * hits.distance_mm
        rows = np.flatnonzero(near & (-dot(normals, rays) > GRAZING))
        normals, measured, met = normals[rows], measured[rows], met[rows]
        distance_mm = dot(normals, measured - met)
        width_mm = robust_std(distance_mm, 1e-6)
        weight = 1 / np.maximum(1, np.abs(distance_mm) / (HUBER * width_mm)) / (width_mm**2 * ALIKE)
        slopes = np.concatenate([np.cross(measured, normals), normals], axis=1)
        return cls(met @ pose[:3, :3].T + pose[:3, 3], distance_mm, slopes, weight, width_mm)

    @property
    def tells(self) -> bool:
        return len(self.weight) >= LEAST_POINTS


def beside(caster: Caster, sequence: Sequence, poses: np.ndarray, frames: np.ndarray) -> Iterator[_Beside]:
    """What the depth maps of ``frames`` [F] show beside the surface of ``caster`` at ``poses`` [N, 4, 4]."""
    caster = caster.threaded(1)
    return ahead(lambda f: _Beside.of(caster, sequence, poses[f], f), frames.tolist(), THREADS)


def _width_mm(maps: list[_Beside]) -> float:
    """Robust width of the maps' distances to the surface, mean of those that tell."""
    widths = [each.width_mm for each in maps if each.tells]
    return float(np.mean(widths)) if widths else 0.0


def each_alone(maps: Iterable[_Beside]) -> np.ndarray:
    """The twist [F, 6] that brings each depth map next to a surface that stays."""

    def alone(each: _Beside) -> np.ndarray:
        if not each.tells:
            return np.zeros(6)
        normal = (each.slopes * each.weight[:, None]).T @ each.slopes + _PRIOR
        return np.linalg.solve(normal, -each.slopes.T @ (each.weight * each.distance_mm))

    return np.stack([alone(each) for each in maps])


def all_together(maps: list[_Beside], own: np.ndarray, cell_mm: float) -> np.ndarray:
    """The twist [F, 6] that brings each depth map next to the others, wherever the surface then lies: bends
    of the whole path would else unbend by a little in each round.

    Args:
        own: [F, 6], how far each has moved from where it was written. cell_mm: places of this size have a
            level of their own.
    """
    count = len(maps)
    frame = np.repeat(np.arange(count), [len(each.weight) for each in maps])
    points, distance, slopes, weight = (
        np.concatenate([getattr(each, name) for each in maps])
        for name in ("points_mm", "distance_mm", "slopes", "weight")
    )
    place = numbered(np.floor(points / cell_mm).astype(np.int64))
    places = int(place.max()) + 1 if len(place) else 0
    pair, which = np.unique(frame * places + place, return_inverse=True)
    total = np.bincount(which, weight)
    frame, place = pair // places, pair % places
    distance, *slopes = (np.bincount(which, weight * x) / total for x in (distance, *slopes.T))
    distance -= (np.bincount(place, total * distance) / np.bincount(place, total))[place]
    matrix, right = coupled(np.stack(slopes, axis=1), distance, total, frame, place, (count, places))
    normal = matrix.reshape(6 * count, 6 * count) + np.kron(np.eye(count), _PRIOR)
    pull = right.reshape(-1) - (own @ _PRIOR).reshape(-1)
    return np.linalg.solve(normal, pull).reshape(count, 6)


def gain_db(twin: Twin, sequence: Sequence, caster: Caster) -> float:
    """By how much the disagreement of some depth maps falls if each moves by itself, dB."""
    training = np.array(twin.source.training(len(sequence)))
    some = training[spread(len(training), GLANCE_FRAMES)]
    poses = sequence.T_world_camera.copy()
    maps = list(beside(caster, sequence, poses, some))
    poses[some] = moved(poses[some], each_alone(maps))
    before, after = (_width_mm(each) for each in (maps, list(beside(caster, sequence, poses, some))))
    return 20 * float(np.log10(before / after)) if min(before, after) > 0 else 0.0


def _nearer(surface: Surface, sequence: Sequence, now: Corrections, frames: np.ndarray) -> Corrections:
    """The corrections that bring the depth maps of ``frames`` [F] next to each other, and those beyond
    TOGETHER next to the surface."""
    caster, stays = Caster(surface), np.zeros(len(now.shared))
    some = frames[spread(len(frames), TOGETHER)]
    for _ in range(STEPS):
        maps = list(beside(caster, sequence, now.poses, some))
        now = now.stepped(stays, all_together(maps, now.own[some], CELL_MM * unit_mm(surface)), some)
    if len(some) < len(frames):
        now = now.stepped(stays, each_alone(beside(caster, sequence, now.poses, frames)), frames)
    return now


def registered(
    twin: Twin, sequence: Sequence, progress: Callable[[str, int, int], None]
) -> tuple[Surface, Corrections]:
    """The surface fused again from depth maps that moved next to each other, and their poses' corrections.

    Held-out frames whose depth the twin may not know follow the drift of the others.
    """
    from endotwin import fusion  # with Open3D, which takes two seconds and is seldom needed here

    training = twin.source.training(len(sequence))
    heldout = twin.source.heldout(len(sequence)) if twin.source.geometry == "known" else []
    frames = np.array(sorted({*training, *heldout}))
    made = twin.record.get("fuse", {})
    config = FuseConfig(**made.get("config", {}))
    now, surface = Corrections.none(sequence.T_world_camera), twin.surface
    for number in range(ROUNDS):
        now = _nearer(surface, sequence, now, frames)
        factor = config.voxel * (1 if number == ROUNDS - 1 else COARSER)
        at_poses = replace(sequence, T_world_camera=now.poses)
        voxel_mm = made.get("voxel_mm")
        if voxel_mm is not None and number < ROUNDS - 1:
            voxel_mm *= COARSER
        surface = fusion.fuse(at_poses, frames.tolist(), training, voxel_mm, factor)
        progress("align depth maps", number + 1, ROUNDS)
    return surface, now

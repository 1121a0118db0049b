"""Depth maps that move with their photos: where they disagree with the surface that they were fused to, their
poses are wrong, whatever the photos show.

Point-to-plane registration of every frame to the surface of all (Chen & Medioni 1992), which is fused again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from endotwin.align.corrections import Corrections, shared_spread
from endotwin.align.motion import moved
from endotwin.config import FuseConfig
from endotwin.run.ahead import ahead
from endotwin.run.threads import THREADS
from endotwin.sequence import Sequence
from endotwin.sequence.spread import spread
from endotwin.surface import Surface
from endotwin.surface.casting import Caster
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

ROUNDS, STEPS = 4, 3
"""Of fusing, and of steps on each surface."""

COARSER = 2.0
"""Surfaces but the last are fused at so much larger voxels."""

MIN_GAIN_DB = 2.0
"""Depth maps move where that lowers their disagreement by so much."""

GLANCE_FRAMES = 12


def disagreement(
    caster: Caster, sequence: Sequence, poses: np.ndarray, frames: np.ndarray
) -> tuple[np.ndarray, float]:
    """The twist [F, 6] that brings each depth map of ``frames`` [F] next to the surface of ``caster``, and
    the robust width of their distances to it now, in mm.

    Args:
        poses: T_world_camera [N, 4, 4] by frame.
    """
    caster = caster.threaded(1)
    found = list(ahead(lambda f: _one(caster, sequence, poses[f], f), frames.tolist(), THREADS))
    widths = [width for _, width in found if width > 0]
    return np.array([twist for twist, _ in found]), float(np.mean(widths)) if widths else 0.0


def _one(caster: Caster, sequence: Sequence, pose: np.ndarray, frame: int) -> tuple[np.ndarray, float]:
    depth_mm = sequence.depth_mm(frame)
    known = np.flatnonzero(np.isfinite(depth_mm))
    drawn = np.random.default_rng(frame).choice(known, min(PIXELS, len(known)), replace=False)
    chosen = np.zeros(depth_mm.size, bool)
    chosen[drawn] = True
    hits = caster.cast(sequence.camera, pose, chosen.reshape(depth_mm.shape))
    rays = sequence.camera.pixel_directions.reshape(-1, 3)[hits.pixel].astype(np.float64)
    measured = rays * (depth_mm.reshape(-1)[hits.pixel] / rays[:, 2])[:, None]
    normals = unit(hits.interpolate(caster.surface, caster.surface.normals).astype(np.float64) @ pose[:3, :3])
    apart = measured - rays * hits.distance_mm[:, None]
    near = np.abs(dot(apart, rays)) < FARTHEST * hits.distance_mm
    rows = np.flatnonzero(near & (-dot(normals, rays) > GRAZING))
    if len(rows) < 100:
        return np.zeros(6), 0.0
    normals, measured = normals[rows], measured[rows]
    distance = dot(normals, apart[rows])
    width = max(1.4826 * float(np.median(np.abs(distance))), 1e-6)
    weight = 1 / np.maximum(1, np.abs(distance) / (HUBER * width)) / (width**2 * ALIKE)
    slopes = np.concatenate([np.cross(measured, normals), normals], axis=1)
    normal = (slopes * weight[:, None]).T @ slopes + np.diag(1 / shared_spread()[:6] ** 2)
    return np.linalg.solve(normal, -slopes.T @ (weight * distance)), width


def gain_db(twin: Twin, sequence: Sequence, caster: Caster) -> float:
    """By how much the disagreement of some depth maps falls if each moves by itself, dB."""
    training = np.array(twin.source.training(len(sequence)))
    some = training[spread(len(training), GLANCE_FRAMES)]
    poses = sequence.T_world_camera.copy()
    twists, before = disagreement(caster, sequence, poses, some)
    poses[some] = moved(poses[some], twists)
    after = disagreement(caster, sequence, poses, some)[1]
    return 20 * float(np.log10(before / after)) if min(before, after) > 0 else 0.0


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
        caster = Caster(surface)
        for _ in range(STEPS):
            twists = disagreement(caster, sequence, now.poses, frames)[0]
            now = now.stepped(np.zeros(len(now.shared)), twists, frames)
        factor = config.voxel * (1 if number == ROUNDS - 1 else COARSER)
        at_poses = replace(sequence, T_world_camera=now.poses)
        voxel_mm = made.get("voxel_mm")
        if voxel_mm is not None and number < ROUNDS - 1:
            voxel_mm *= COARSER
        surface = fusion.fuse(
            at_poses, frames.tolist(), training, voxel_mm, factor, lambda stage, done, total: None
        )
        progress("align depth maps", number + 1, ROUNDS)
    return surface, now

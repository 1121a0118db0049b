"""What the fit looks at: training pixels, with the surface point and the geometry behind each."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from endotwin.casting import Caster
from endotwin.incidence import incidence
from endotwin.sequence import Frame
from endotwin.silhouettes import discontinuities
from endotwin.twin import Twin

DEPTH_TOLERANCE_MM = 0.3
DEPTH_TOLERANCE = 0.01
"""A ray agrees with the measured depth within max(DEPTH_TOLERANCE_MM, DEPTH_TOLERANCE·depth)."""

THREADS = 2


@dataclass(frozen=True)
class Samples:
    """N training pixels, ordered by triangle.

    Attributes:
        triangle: int64 [N], ascending. barycentric: float32 [N, 3].
        cos, sin2, log_cos_axis, log_distance: float32 [N], see ``Incidence``.
        color: uint8 [N, 3], display-encoded.
    """

    triangle: Tensor
    barycentric: Tensor
    cos: Tensor
    sin2: Tensor
    log_cos_axis: Tensor
    log_distance: Tensor
    color: Tensor

    def __len__(self) -> int:
        return len(self.triangle)

    def __getitem__(self, index) -> Samples:
        return Samples(**{name: value[index] for name, value in vars(self).items()})

    def thinned(self, count: int, generator: np.random.Generator) -> Samples:
        """About ``count`` of the samples, drawn evenly at random; all of them if there are no more."""
        if len(self) <= count:
            return self
        return self[
            torch.from_numpy(np.flatnonzero(generator.random(len(self), np.float32) < count / len(self)))
        ]

    def chunks(self, size: int) -> Iterator[Samples]:
        """Consecutive pieces of at most ``size`` samples."""
        for start in range(0, len(self), size):
            yield self[start : start + size]


def gather(
    twin: Twin, count: int, seed: int, progress: Callable[[str, int, int], None] | None = None
) -> Samples:
    """At most about ``count`` pixels, drawn evenly from all that the training photos show of the surface.

    A pixel counts if it lies within the lens circle, has a depth, lies off depth discontinuities, and its
    ray meets
    the surface at that depth.
    """
    sequence = twin.source.open()
    frames = twin.source.training(len(sequence))
    share = count / max(1, len(frames) * int(sequence.lens_mask.sum()))
    caster = Caster(twin.surface, threads=1)

    def one(index: int) -> Samples:
        generator = np.random.default_rng((seed, index))
        return _frame_samples(twin, caster, sequence.frame(index), sequence.lens_mask, share, generator)

    parts = []
    with ThreadPoolExecutor(THREADS) as pool:
        for done, part in enumerate(pool.map(one, frames), 1):
            parts.append(part)
            if progress:
                progress("gather pixels", done, len(frames))
    joined = Samples(
        **{f.name: torch.cat([getattr(part, f.name) for part in parts]) for f in fields(Samples)}
    )
    return joined[torch.argsort(joined.triangle, stable=True)]


def _frame_samples(
    twin: Twin,
    caster: Caster,
    frame: Frame,
    lens_mask: np.ndarray,
    share: float,
    generator: np.random.Generator,
) -> Samples:
    chosen = lens_mask & np.isfinite(frame.depth_mm) & ~discontinuities(frame.depth_mm)
    if share < 1:
        chosen &= generator.random(chosen.shape, np.float32) < share
    hits = caster.cast(twin.camera, frame.T_world_camera, chosen)
    depth_mm = frame.depth_mm.reshape(-1)[hits.pixel]
    cast_mm = hits.distance_mm * twin.camera.pixel_directions.reshape(-1, 3)[hits.pixel, 2]
    hits = hits[np.abs(cast_mm - depth_mm) <= np.maximum(DEPTH_TOLERANCE_MM, DEPTH_TOLERANCE * depth_mm)]
    geometry = incidence(hits, twin.surface, twin.camera, frame.T_world_camera)
    return Samples(
        triangle=torch.from_numpy(hits.triangle.astype(np.int64)),
        barycentric=torch.from_numpy(hits.barycentric),
        color=torch.from_numpy(frame.color.reshape(-1, 3)[hits.pixel]),
        **{name: torch.from_numpy(value) for name, value in vars(geometry).items()},
    )

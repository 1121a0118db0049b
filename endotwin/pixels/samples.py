"""What the fit looks at: training pixels, with the surface point and the geometry behind each."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from torch import Tensor

from endotwin.cameras.base import Camera
from endotwin.effects.processor import Processor
from endotwin.effects.tone import Tone
from endotwin.light.bounced import Bounce
from endotwin.light.forward import Lit
from endotwin.light.guides import Guided
from endotwin.light.incidence import incidence
from endotwin.pixels.length_unit import unit_mm
from endotwin.pixels.pace import Pace
from endotwin.run.ahead import ahead
from endotwin.run.threads import THREADS
from endotwin.sequence import Frame
from endotwin.surface import Surface
from endotwin.surface.casting import Caster, Correspondences
from endotwin.surface.rows import chosen
from endotwin.surface.silhouettes import dilated, discontinuities
from endotwin.surface.vectors import unit
from endotwin.twin import Twin

DEPTH_TOLERANCE_MM = 0.3
DEPTH_TOLERANCE = 0.01
"""A ray agrees with the measured depth within max(DEPTH_TOLERANCE_MM, DEPTH_TOLERANCE·depth), the
former in units of the scene."""

BLACK, CLIPPED = 5, 255
LEAST_SHOWN = 0.01
"""A photo with a smaller share between these levels shows nothing: the light was off, or too near."""

logger = logging.getLogger("endotwin")


@dataclass(frozen=True)
class Views:
    """The photos that samples come from.

    Attributes:
        camera: that took them. lens_mask: bool [H, W], pixels within the lens circle.
        frames: int [F], their numbers in the sequence, ascending.
        T_local_camera: float64 [F, 4, 4], their poses in the surface's frame.
        processor: what sharpened them; None: nothing that is told.
    """

    camera: Camera
    lens_mask: np.ndarray
    frames: np.ndarray
    T_local_camera: np.ndarray
    processor: Processor | None = None

    def row(self, frame: Tensor) -> np.ndarray:
        """Where frames [N] stand among ``frames``, int [N]."""
        return np.searchsorted(self.frames, frame.numpy())


@dataclass(frozen=True)
class Samples:
    """N training pixels, ordered by triangle.

    Attributes:
        triangle: int64 [N], ascending. barycentric: float32 [N, 3].
        cos, sin2, log_cos_axis, log_distance: float32 [N], see ``Incidence``.
        color: uint8 [N, 3], display-encoded.
        frame: int32 [N], index of the photo. pixel: int32 [N], row-major.
        guides: how guides beside the lens light the pixels; None: the light is at the lens.
        bounce: what other tissue throws on them; None: nothing.
        log_exposure: float32 [N], ln of gain, and of vignetting but for its k2; None: 0.
        radius2: float32 [N], r² of ``Vignetting``; None: the lens does not vignette.
        views: the photos; None for samples that no photo showed.
    """

    triangle: Tensor
    barycentric: Tensor
    cos: Tensor
    sin2: Tensor
    log_cos_axis: Tensor
    log_distance: Tensor
    color: Tensor
    frame: Tensor
    pixel: Tensor
    guides: Guided | None = None
    bounce: Bounce | None = None
    log_exposure: Tensor | None = None
    radius2: Tensor | None = None
    views: Views | None = None

    def __len__(self) -> int:
        return len(self.triangle)

    def __getitem__(self, index) -> Samples:
        return self._each(lambda value: chosen(value, index))

    def _each(self, change: Callable) -> Samples:
        """The samples with every column changed."""
        rows = {name: value for name, value in vars(self).items() if value is not None and name != "views"}
        return replace(self, **{name: change(value) for name, value in rows.items()})

    def to(self, device: torch.device) -> Samples:
        """The same samples on ``device``; they themselves where they are there."""
        if self.triangle.device == device:
            return self
        return self._each(lambda value: value.to(device))

    @classmethod
    def joined(cls, parts: list[Samples], views: Views | None = None) -> Samples:
        """The samples of all ``parts``, in their order."""
        return _joined([replace(part, views=None) for part in parts], views=views)

    def nearest(self, triangles: np.ndarray) -> np.ndarray:
        """The vertex that each is nearest to, int [N], among the corners of ``triangles`` [F, 3]."""
        return triangles[self.triangle.numpy(), self.barycentric.argmax(dim=1).numpy()]

    @property
    def directions(self) -> np.ndarray:
        """Unit viewing rays in the camera frame, float32 [N, 3]."""
        return self.views.camera.pixel_directions.reshape(-1, 3)[self.pixel.numpy()]

    @property
    def distance_mm(self) -> float:
        """Median viewing distance."""
        return float(np.exp(np.median(self.log_distance.numpy())))

    @property
    def points_mm(self) -> np.ndarray:
        """Surface points in the camera frame, float32 [N, 3]."""
        return self.directions * self.log_distance.exp().numpy()[:, None]

    @property
    def rotation(self) -> np.ndarray:
        """From the camera of each to the surface's frame, float32 [N, 3, 3]."""
        return self.views.T_local_camera[:, :3, :3].astype(np.float32)[self.views.row(self.frame)]

    def normals(self, surface: Surface) -> np.ndarray:
        """Unit normals of the ``surface`` that they lie on, in the camera frame of each, float32 [N, 3]."""
        corners = surface.normals[surface.triangles[self.triangle.numpy()]]
        share = self.barycentric.numpy()
        return unit(np.einsum("nk,nka,nab->nb", share, corners, self.rotation, optimize=True))

    def lit(self, n: float, q: float, log_scale: float = 0.0, gamma: float = 0.0, f0: float = 0.0) -> Lit:
        """What lights the pixels; n, q, the scale of albedos, γ and f0 say how light bounces."""
        more = {"log_exposure": self.log_exposure}
        if self.bounce is not None:
            irradiance = self.bounce.irradiance(n, q, log_scale, gamma, f0)
            mirrored = self.bounce.mirrored(irradiance)
            more |= {"irradiance": irradiance, "mirrored": mirrored, "gloss": self.bounce.glossy(f0)}
        if self.guides is not None:
            return Lit(self.cos, self.guides, **more)
        return Lit.at_lens(self.cos, self.sin2, self.log_cos_axis, self.log_distance, **more)

    def untoned(self, tone: Tone) -> Samples:
        """The same samples with a tone curve taken off their photos."""
        levels = np.arange(256, dtype=np.float32) / 255
        level = torch.from_numpy(np.rint(255 * tone.undone(levels)).astype(np.uint8))
        return replace(self, color=level[self.color.long()])

    def thinned(self, count: int, generator: np.random.Generator) -> Samples:
        """About ``count`` of the samples, drawn evenly at random; all of them if there are no more."""
        if len(self) <= count:
            return self
        return self[torch.from_numpy(drawn(len(self), count, generator))]

    def chunks(self, size: int) -> Iterator[Samples]:
        """Consecutive pieces of at most ``size`` samples."""
        for start in range(0, len(self), size):
            yield self[start : start + size]


def drawn(count: int, wanted: int, generator: np.random.Generator) -> np.ndarray:
    """About ``wanted`` of ``count`` rows, drawn evenly at random, ascending; all if there are no more."""
    if count <= wanted:
        return np.arange(count)
    return np.flatnonzero(generator.random(count, np.float32) < wanted / count)


def whole_groups(
    group: np.ndarray, count: int, wanted: int, generator: np.random.Generator, least: int = 1
) -> np.ndarray:
    """Rows of whole groups, ascending, drawn at random until ``wanted`` rows are there, or all; groups with
    fewer than the ``least`` rows are left out.

    Args:
        group: int [N], below ``count``.
    """
    size = np.bincount(group, minlength=count)
    order = generator.permutation(np.flatnonzero(size >= least))
    taken = np.zeros(count, bool)
    taken[order[: int(np.searchsorted(np.cumsum(size[order]), wanted)) + 1]] = True
    return np.flatnonzero(taken[group])


def _joined(parts: list, **more):
    """Dataclasses of one kind whose columns, and those of their columns, are joined; None stays None."""
    columns = {}
    for name, value in vars(parts[0]).items():
        values = [getattr(part, name) for part in parts]
        if isinstance(value, Tensor):
            columns[name] = torch.cat(values)
        elif value is not None:
            columns[name] = _joined(values)
    return type(parts[0])(**columns | more)


def gather(twin: Twin, pace: Pace, seed: int, caster: Caster) -> Samples:
    """About ``pace.pixels`` pixels, or all, drawn evenly from what its photos show of the surface.

    A pixel counts if it lies within the lens circle, has a depth, lies off depth discontinuities, and its
    ray meets the surface at that depth, unless the photos were aligned apart from their depth maps. A photo
    that is all black or clipped is left out with a warning, unless all are. Photos that a processor sharpened
    are taken as they were before.
    """
    sequence = twin.sequence()
    frames = twin.source.training(len(sequence))
    share = pace.share(len(frames), int(sequence.lens_mask.sum()))
    processor, _ = Processor.evidence(sequence, frames)

    def one(index: int) -> tuple[int, Samples]:
        generator = np.random.default_rng((seed, index))
        frame = unsharpened(sequence.frame(index), processor)
        return index, frame_samples(twin, caster, frame, sequence.lens_mask, share, generator)

    read, parts = [], []
    for done, (index, part) in enumerate(ahead(one, pace.photos(frames), THREADS), 1):
        read.append(index)
        parts.append(part)
        pace.report("gather pixels", done, len(frames))
    shows = [len(part) > 0 and _shown(part) >= LEAST_SHOWN for part in parts]
    for index, part, tells in zip(read, parts, shows, strict=True):
        if len(part) and not tells and any(shows):
            logger.warning("%s is black or clipped and is not fitted", sequence.color_files[index])
    parts = [part for part, tells in zip(parts, shows, strict=True) if tells or not any(shows)]
    joined = Samples.joined(parts)
    shown = np.unique(joined.frame.numpy())
    T_local_camera = twin.surface.to_local(sequence.T_world_camera[shown])
    views = Views(twin.camera, sequence.lens_mask, shown, T_local_camera, processor)
    return replace(joined[torch.argsort(joined.triangle, stable=True)], views=views)


def unsharpened(frame: Frame, processor: Processor | None) -> Frame:
    """The frame with its photo as it was before ``processor`` sharpened it, if one did."""
    return frame if processor is None else replace(frame, color=processor.unsharpened(frame.color))


def _shown(part: Samples) -> float:
    """The share of the samples that are neither black nor clipped."""
    brightest = part.color.max(dim=1).values
    return float(((brightest > BLACK) & (brightest < CLIPPED)).float().mean())


def frame_samples(
    twin: Twin,
    caster: Caster,
    frame: Frame,
    lens_mask: np.ndarray,
    share: float,
    generator: np.random.Generator,
) -> Samples:
    chosen = lens_mask & np.isfinite(frame.depth_mm) & ~beside_black(frame.color)
    if twin.depth_at_photos:
        chosen &= ~discontinuities(frame.depth_mm)
        if share < 1:
            chosen &= generator.random(chosen.shape, np.float32) < share
        hits = caster.cast(twin.camera, frame.T_world_camera, chosen)
        hits = hits[_at_depth(hits, frame.depth_mm, twin)]
    else:
        hits = _off_rims(caster.cast(twin.camera, frame.T_world_camera, chosen), chosen.shape)
        hits = hits[generator.random(len(hits), np.float32) < share]
    geometry = incidence(hits, twin.surface, twin.camera, frame.T_world_camera)
    return Samples(
        triangle=torch.from_numpy(hits.triangle.astype(np.int64)),
        barycentric=torch.from_numpy(hits.barycentric),
        color=torch.from_numpy(frame.color.reshape(-1, 3)[hits.pixel]),
        frame=torch.full((len(hits),), frame.index, dtype=torch.int32),
        pixel=torch.from_numpy(hits.pixel.astype(np.int32)),
        **{name: torch.from_numpy(value) for name, value in vars(geometry).items()},
    )


def beside_black(color: np.ndarray) -> np.ndarray:
    """Bool [H, W]: pixels of a photo [H, W, 3] that show light, beside one that shows none: the edge of a
    shadow, or of the lens's picture, may run through them, so that they show part of what is there."""
    black = cv2.inRange(color, (0,) * 3, (BLACK,) * 3) > 0
    return dilated(black, 1) & ~black


def _at_depth(hits: Correspondences, depth_mm: np.ndarray, twin: Twin) -> np.ndarray:
    """Bool [N]: hits that lie at the measured depth [H, W] of their pixel."""
    measured_mm = depth_mm.reshape(-1)[hits.pixel]
    cast_mm = hits.distance_mm * twin.camera.pixel_directions.reshape(-1, 3)[hits.pixel, 2]
    least_mm = unit_mm(twin.surface) * DEPTH_TOLERANCE_MM
    return np.abs(cast_mm - measured_mm) <= np.maximum(least_mm, DEPTH_TOLERANCE * measured_mm)


def _off_rims(hits: Correspondences, shape: tuple[int, int]) -> Correspondences:
    """Hits off the silhouettes that they themselves show: a photo that was aligned is not where its depth map
    is."""
    distance_mm = np.zeros(shape[0] * shape[1], np.float32)
    distance_mm[hits.pixel] = hits.distance_mm
    return hits[~discontinuities(distance_mm.reshape(shape)).reshape(-1)[hits.pixel]]

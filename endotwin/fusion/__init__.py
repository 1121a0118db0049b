"""Depth maps and poses become one surface: TSDF fusion, refinement, carve and patch, coverage."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from collections.abc import Sequence as Indices
from functools import partial

import numpy as np

from endotwin.errors import OptionError
from endotwin.fusion.agreement import Tolerance, measured_noise
from endotwin.fusion.choice import WORTH_PIXELS, chosen, compared, differing, glances
from endotwin.fusion.coverage import covered, covered_by_glances
from endotwin.fusion.denoise import denoised, pixel_noise
from endotwin.fusion.doubts import doubt_frames, doubt_scatter, without_strays
from endotwin.fusion.faces import split
from endotwin.fusion.holes import filled
from endotwin.fusion.margin import with_margin
from endotwin.fusion.mesh import surface_of, without_short_edges
from endotwin.fusion.reconcile import reconciled
from endotwin.fusion.refine import refined
from endotwin.fusion.smooth import smoothed
from endotwin.fusion.tsdf import footprint_voxel_mm, fuse_tsdf
from endotwin.fusion.views import Shelf, View, read_views
from endotwin.fusion.wall import with_wall
from endotwin.run.arguments import check_positive
from endotwin.sequence import Sequence
from endotwin.sequence.spread import spread
from endotwin.surface import Surface
from endotwin.surface.casting import Caster

__all__ = ["fuse"]

SAMPLED_FRAMES = 12
SHORTEST_EDGE_VOXELS = 0.25
"""Marching cubes leaves slivers with edges shorter than this; their ends are made one."""
NOISY_FOLD = 4
"""So many frames see each place where depth is noisy, and is averaged over them."""
COARSE_VOXELS = 2.5
"""The noise is measured about a surface this many times coarser than the finest, whose truncation band it
rarely leaves."""
COARSE_ERRS = 0.3
"""Share of its voxel by which that surface itself errs where much bends within one."""
REACH_SIGMAS = 3.0
WIDTH_PX = 4.0
"""Distances are averaged over so many pixels where their noise is as large as the finest voxel."""

Progress = Callable[[str, int, int], None]


def fuse(
    sequence: Sequence,
    frames: Indices[int] | None = None,
    photo_frames: Indices[int] | None = None,
    voxel_mm: float | None = None,
    voxel: float = 1.0,
    progress: Progress | None = None,
    record: dict | None = None,
) -> Surface:
    """The surface that agrees with the depth maps of ``frames``; the same input gives the same mesh.

    TSDF fusion, vertices refined against the depth maps, two rounds of carve and patch, small holes filled, a
    margin about the pictures, coverage. Noise that differs from pixel to pixel is averaged out first. As many
    frames are in memory as SHELF_BYTES hold, and a few more. A frame without any valid depth, or whose camera
    lies beyond what the others see, is left out with a warning in the log ``endotwin``. Of many pixels, only
    the frames that see something new are fused (see ``choice``).

    Args:
        frames: indices whose depth may be used; all unless given.
        photo_frames: indices that count for the coverage; ``frames`` unless given.
        voxel_mm: voxel edge of the TSDF; chosen from the pixel footprint and the noise unless given.
        voxel: factor on the edge that is chosen, as far as memory allows.
        progress: called with (stage, done, total) as each frame of a stage begins.
        record: to which the frames that were fused, and the number of those with nothing new, are added.

    Raises:
        SequenceError: no frame has valid depth, or the depth gives no surface.
        OptionError: a voxel size, or a factor on it, that is not positive; a size that no memory holds; no
            frames.
    """
    frames = list(range(len(sequence)) if frames is None else frames)
    photo_frames = frames if photo_frames is None else list(photo_frames)
    if not frames:
        raise OptionError("No frames are left to fuse; choose at least one.")
    check_positive("factor on voxels", voxel)
    if voxel_mm is not None:
        check_positive("voxel size in mm", voxel_mm)
    sequence.require_valid_depth()
    camera, sample = sequence.camera, [frames[k] for k in spread(len(frames), SAMPLED_FRAMES)]

    reading: dict = {"shelf": Shelf()}

    def views(stage: str, of: list[int], warn: bool = False) -> Iterator[View]:
        return read_views(sequence, _reported(stage, of, progress), warn, **reading)

    finest_mm, median_mm, least_mm = footprint_voxel_mm(camera, views("voxel size", sample))
    scatter = pixel_noise(views("pixel noise", sample))
    width_px = WIDTH_PX * scatter * median_mm / finest_mm
    if width_px >= 1:
        reading = {"shelf": Shelf(), "change": partial(denoised, noise=scatter, width_px=width_px)}
    frames = without_strays(sequence, frames, median_mm)
    sample = [frames[k] for k in spread(len(frames), SAMPLED_FRAMES)]
    if voxel_mm is not None and voxel_mm > median_mm:
        raise OptionError(
            f"A voxel of {voxel_mm:g} mm is larger than the usual depth, {median_mm:.3g} mm; choose less."
        )
    if voxel_mm is not None and voxel_mm < least_mm:
        raise OptionError(
            f"A voxel of {voxel_mm:g} mm needs more than 2 GB of memory; choose {least_mm:.2g} or more."
        )
    origin_mm = np.median(np.asarray(sequence.T_world_camera, np.float64)[frames, :3, 3], axis=0)
    coarse_mm = COARSE_VOXELS * finest_mm
    faces = split(camera)
    coarse = fuse_tsdf(faces, views("noise", sample), origin_mm, coarse_mm, noise_mm=0.0)
    noise = measured_noise(camera, surface_of(origin_mm, *coarse), views("noise", sample))
    if voxel_mm is None:
        voxel_mm = max(voxel * max(finest_mm, noise * median_mm), least_mm)
    tolerance = Tolerance.of(voxel_mm, noise)
    doubt_scatter(sequence, max(noise - COARSE_ERRS * coarse_mm / median_mm, scatter))

    seen = None
    if len(frames) * camera.width * camera.height > WORTH_PIXELS:
        seen = glances(sequence, _reported("choose frames", frames, progress))
        frames = [glance.index for glance in seen]
    fused = frames if seen is None else chosen(camera, seen, 1 if width_px < 1 else NOISY_FOLD)
    vertices_mm, triangles = fuse_tsdf(
        faces, views("TSDF", fused, warn=True), origin_mm, voxel_mm, noise * median_mm
    )
    vertices_mm, triangles = without_short_edges(vertices_mm, triangles, SHORTEST_EDGE_VOXELS * voxel_mm)
    surface = surface_of(origin_mm, vertices_mm, triangles)
    surface = refined(
        camera, surface, views("refine", fused), max(voxel_mm, REACH_SIGMAS * noise * median_mm)
    )
    surface, shares = reconciled(camera, surface, views("carve and patch", fused), tolerance)
    if seen is not None:
        shares, places = compared(camera, Caster(surface), seen, tolerance)
        fused = sorted([*fused, *differing(places, fused)])
    doubt_frames(sequence, shares)
    surface, _ = reconciled(camera, surface, views("carve and patch again", fused), tolerance)
    surface = filled(camera, surface, views("fill holes", fused), tolerance, voxel_mm)
    strips = (views(stage, fused) for stage in ("go on beside pictures", "keep what is sound"))
    surface = with_margin(camera, surface, *strips, tolerance, median_mm)
    surface = smoothed(surface)
    photos = [index for index in photo_frames if seen is None or index in set(fused)]
    surface = covered(camera, surface, views("coverage", photos), sequence.lens_mask, tolerance)
    if seen is not None:
        others = [glance for glance in seen if glance.index in set(photo_frames) - set(photos)]
        surface = covered_by_glances(camera, surface, others, sequence.lens_mask, tolerance)
    surface = with_wall(camera, surface, np.asarray(sequence.T_world_camera)[fused], median_mm)
    if record is not None:
        record.update(fused=fused, nothing_new=len(frames) - len(fused))
    return surface


def _reported(stage: str, frames: list[int], progress: Progress | None) -> Iterable[int]:
    """``frames``, with ``progress`` called as each is taken."""
    for done, index in enumerate(frames, start=1):
        if progress is not None:
            progress(stage, done, len(frames))
        yield index

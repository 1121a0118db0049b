"""The surface goes on a little beyond what the depth maps' pictures show.

Where photos are not quite where depth was measured from, as those that were registered to a model, some show
a strip beside every depth map; and no tissue ends there.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from endotwin.cameras import Camera
from endotwin.cameras.base import padded
from endotwin.fusion.agreement import Tolerance, against, compare
from endotwin.fusion.mesh import single, surface_of
from endotwin.fusion.patch import Patches
from endotwin.fusion.views import View
from endotwin.run.ahead import ahead
from endotwin.run.threads import THREADS
from endotwin.surface import Surface
from endotwin.surface.casting import Caster

ERROR_MM, ERROR_DEG = 0.32, 0.16
"""Mean error of C3VD's registration (Bobrow et al. 2023)."""

ERRORS = 2.0
"""The surface goes on so many errors far."""

MOST = 1 / 16
"""Of the picture's smaller side: where tissue is so near that errors reach farther, as where depth is in
another unit, what lies there is anyone's guess."""

FIT_PX = 8
"""The slope with which distance goes on is that of so many pixels."""

STEEPEST = 0.3
"""Where the inverse distance would change by more than this share, that is a rim, and nothing goes on."""

SEWN_PX = 3
"""So many pixels inside the picture are where a strip is sewn on."""


def with_margin(
    camera: Camera,
    surface: Surface,
    views: Iterable[View],
    again: Iterable[View],
    tolerance: Tolerance,
    median_mm: float,
) -> Surface:
    """``surface`` continued beyond the pictures of ``views``, where it ends there; new vertices are marked
    ``filled``.

    Distance goes on with the slope of its inverse, which hardly bends on a plane. What lies before or at what
    one of the views, given ``again``, measured is left out: that place is known.
    """
    by = margin_px(camera, median_mm)
    wide = padded(camera, by)
    caster = Caster(surface)
    patches = Patches(wide, caster)
    for seen in compare(wide, caster, (_continued(view, by) for view in views), tolerance):
        patches.add(replace(seen, lacking=seen.lacking & (seen.triangle < 0)))
    first = len(surface.vertices_mm)
    added_mm = patches.vertices_mm[first:]
    if not len(added_mm):
        return surface

    def measured(view: View) -> np.ndarray:
        inside, before, at = against(camera, surface, added_mm, view, tolerance)
        inside[inside] = before | at
        return inside

    sound = np.ones(len(patches.vertices_mm), bool)
    for known in ahead(measured, again, threads=THREADS):
        sound[first:] &= ~known
    triangles = patches.triangles[sound[patches.triangles].all(axis=1)]
    return surface_of(
        surface.origin_mm,
        patches.vertices_mm,
        single(np.concatenate([surface.triangles, triangles])),
        np.r_[surface.filled, np.ones(len(added_mm), bool)],
    )


def margin_px(camera: Camera, median_mm: float) -> int:
    """How far the surface goes on beside pictures of tissue at ``median_mm``, in pixels."""
    pixel = float(np.nanmedian(np.linalg.norm(np.diff(camera.pixel_directions, axis=1), axis=-1)))
    by = np.ceil(ERRORS * (ERROR_MM / median_mm + np.radians(ERROR_DEG)) / pixel)
    return int(min(by, np.ceil(MOST * min(camera.width, camera.height))))


def _continued(view: View, by: int) -> View:
    """The strip along the border of a view, going on by so many pixels; NaN within."""
    inverse = 1 / view.distance_mm
    for _ in range(2):
        ends = (_before(inverse, by), inverse, _before(inverse[::-1], by)[::-1])
        inverse = np.concatenate(ends).T
    distance_mm = np.ascontiguousarray(1 / inverse)
    within = slice(by + SEWN_PX, -by - SEWN_PX)
    distance_mm[within, within] = np.nan
    return replace(view, distance_mm=distance_mm)


def _before(inverse: np.ndarray, by: int) -> np.ndarray:
    """What comes before the first row of inverse distances [H, W], [by, W]."""
    near = inverse[:FIT_PX]
    row = np.arange(len(near)) - (len(near) - 1) / 2
    slope = row.astype(np.float32) @ near / max(float(row @ row), 1)
    steps = (np.arange(-by, 0) - (len(near) - 1) / 2).astype(np.float32)
    found = near.mean(axis=0) + steps[:, None] * slope
    with np.errstate(invalid="ignore"):
        return np.where(np.abs(found / near[0] - 1) <= STEEPEST, found, np.float32(np.nan))

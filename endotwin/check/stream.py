"""Every frame beside the one before it, in one pass: what repeats, what moves, and how well poses fit.

Two frames are in memory. A pose is judged by the systematic part of the depth residual that a small motion of
the camera would remove, so that depth noise does not hide it.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from endotwin.check.depths import lookup, prepared
from endotwin.check.photo import brightest, correlation, reduced_photo, reduced_shading
from endotwin.check.reading import Reading
from endotwin.check.views import Views, sampled
from endotwin.check.warp import landed, residuals
from endotwin.robust import robust_std
from endotwin.run.ahead import ahead
from endotwin.sequence import Sequence

POINTS = 2000
LEAST_DEPTH = 200  # pixels of a frame that can be judged


@dataclass(frozen=True)
class Shot:
    """A frame in memory."""

    index: int
    inverse: np.ndarray
    photo: np.ndarray
    shading: np.ndarray
    blocks: np.ndarray
    sharpness: float
    photo_bytes: int
    depth_bytes: int


@dataclass(frozen=True)
class Step:
    """What happens from frame ``index − 1`` to ``index``.

    Attributes:
        motion_px: median motion of the pixels as the poses have it.
        misfit: relative displacement of the surface that the poses leave; inf where nothing lands.
        same_photo, same_depth, same_pose: the two are identical.
        change: mean difference of the photos' block means, in levels of 255.
        before, after: correlation of the earlier frame's photo with the later depth map, and of the later
            photo with the earlier depth map.
    """

    index: int
    motion_px: float
    misfit: float
    same_photo: bool
    same_depth: bool
    same_pose: bool
    change: float
    before: float
    after: float


def shots_and_steps(
    sequence: Sequence, written: np.ndarray, reading: Reading
) -> Iterator[tuple[Shot, Step | None]]:
    """Each frame, and what happened since the one before; None for the first."""
    rays = sequence.camera.pixel_directions

    def read(index: int) -> Shot:
        color, depth_mm = sequence.color(index), sequence.depth_mm(index)
        grey = brightest(color)
        depth = prepared(depth_mm, rays[..., 2])
        size = (max(grey.shape[1] // 8, 1), max(grey.shape[0] // 8, 1))
        return Shot(
            index=index,
            inverse=depth.inverse,
            photo=reduced_photo(color),
            shading=reduced_shading(depth_mm, rays, depth.noise),
            blocks=cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32),
            sharpness=sharpness_of(grey),
            photo_bytes=zlib.crc32(color),
            depth_bytes=zlib.crc32(depth_mm),
        )

    last = None
    for shot in ahead(read, range(len(sequence)), 2):
        yield shot, None if last is None else _step(sequence, written, reading, last, shot)
        last = shot


def sharpness_of(grey: np.ndarray) -> float:
    """ln of fine over coarse detail of a photo uint8 [H, W]; −inf where there is no detail at all."""
    level = grey.astype(np.float32)
    blurs = [cv2.GaussianBlur(level, (0, 0), sigma) for sigma in (0.8, 1.6, 3.2)]
    half = cv2.resize(blurs[2], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    coarse = np.abs(half - cv2.GaussianBlur(half, (0, 0), 3.0)).mean()
    fine = np.abs(blurs[0] - blurs[1]).mean()
    return float(np.log(fine / coarse)) if fine > 0 and coarse > 0 else -np.inf


def _step(sequence: Sequence, written: np.ndarray, reading: Reading, last: Shot, shot: Shot) -> Step:
    views = pair_of(sequence, written, last, shot)
    motion_px, misfit = misfit_of(views, reading)
    return Step(
        index=shot.index,
        motion_px=motion_px,
        misfit=misfit,
        same_photo=last.photo_bytes == shot.photo_bytes,
        same_depth=last.depth_bytes == shot.depth_bytes,
        same_pose=bool(np.array_equal(written[last.index], written[shot.index])),
        change=float(np.abs(last.blocks - shot.blocks).mean()),
        before=correlation(last.photo, shot.shading),
        after=correlation(shot.photo, last.shading),
    )


def pair_of(sequence: Sequence, written: np.ndarray, source: Shot, target: Shot) -> Views:
    """Two frames as views, with the points of the first."""
    inverse, ends = np.stack([source.inverse, target.inverse]), np.array([[0, 1]])
    pixel, depth, pair = sampled(inverse, ends, POINTS, np.random.default_rng(target.index))
    return Views(
        sequence=sequence,
        written=written,
        frames=np.array([source.index, target.index]),
        inverse=inverse,
        noise=0.0,
        left=0.0,
        source=ends[pair, 0],
        target=ends[pair, 1],
        pixel=pixel,
        depth=depth,
        pair=pair,
        ends=ends,
    )


def misfit_of(views: Views, reading: Reading) -> tuple[float, float]:
    """Median motion in pixels from a pair's first view to the second, and the misfit of their poses.

    The misfit is the root mean square of the part of the residuals ln z that the six small motions of the
    camera explain, less what they would explain of noise: a surface displaced by that share of its depth.
    Both are NaN where a view has hardly any depth, or the reading no pose for it.
    """
    known = np.isfinite(views.inverse).sum(axis=(1, 2)).min()
    if known < LEAST_DEPTH or not np.isfinite(reading.poses(views.written, views.frames)).all():
        return np.nan, np.nan
    with np.errstate(all="ignore"):
        points, uv = landed(views, reading)
        motion = np.linalg.norm(uv - views.pixel, axis=1)
        residual = residuals(views, reading)
        slopes = [_moved_residual(views, reading, points, way) - residual for way in np.eye(6) * 1e-3]
    slopes = np.stack(slopes, axis=1)
    good = np.isfinite(residual) & np.isfinite(slopes).all(axis=1) & (np.abs(residual) < 0.5)
    motion_px = float(np.nanmedian(motion)) if np.isfinite(motion).any() else np.inf
    if good.sum() < 100:
        return motion_px, np.inf
    r, J = residual[good], slopes[good] / np.abs(slopes[good]).mean(axis=0)
    steep = np.abs(J).max(axis=1) > 20
    r, J = r[~steep], J[~steep]
    width = robust_std(r, 1e-7)
    weight = 1 / (1 + (r / (2 * width)) ** 2)
    curvature = (J * weight[:, None]).T @ J + 1e-9 * np.eye(6)
    pull = J.T @ (weight * r)
    explained = float(pull @ np.linalg.solve(curvature, pull)) / weight.sum()
    left = r - J @ np.linalg.solve(curvature, pull)
    noise = float((weight * left**2).sum() / weight.sum()) * 6 / len(r)
    return motion_px, float(np.sqrt(max(explained - noise, 0)))


def _moved_residual(views: Views, reading: Reading, points: np.ndarray, way: np.ndarray) -> np.ndarray:
    """Residuals after a small translation (relative to the median depth) and rotation of the points."""
    scale = np.nanmedian(np.abs(points[:, 2]))
    moved = points + way[:3] * scale + np.cross(way[3:], points)
    uv = reading.lens.image(views.sequence.camera.project(moved))
    cosine = moved[:, 2] / np.linalg.norm(moved, axis=1)
    return np.log(moved[:, 2] * lookup(views.inverse, views.target, uv)) - reading.ray * np.log(cosine)

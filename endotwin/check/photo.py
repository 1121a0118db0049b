"""Whether photos and depth maps show the same thing at the same pixel and the same time.

A depth map predicts the photo's shading under a light at the lens: log(n·ω) + 2 log cosθ − 2 log d.
High-passed, it correlates with the photo whatever the exposure, gain or response. To a fraction of a pixel it
is the rims of folds that tell: depth jumps there, and the photo turns dark.

Limits, measured on path-traced sequences with and without 1 % of depth noise: rims place a photo to 0.25 px
(texture and shadows beside the rims); an offset below ``LEAST_OFFSET`` cannot be told.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from endotwin.check.depths import LEAST_COSINE, QUIET, prepared
from endotwin.robust import robust_std
from endotwin.run.ahead import ahead
from endotwin.sequence import Sequence
from endotwin.sequence.spread import spread

GRID = 320  # pixels across the reduced images that are correlated
REACH = 12  # reduced pixels that photo and depth may lie apart
LEAST_SIDE = 4 * REACH  # of reduced images: of smaller ones too little stays when they are moved so far
FRAMES = 12
SHIFTS = (0, -1, 1, -2, 2, -3, 3, -4, 4, -5, 5)
FLIPS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "none": lambda image: image,
    "left to right": lambda image: image[:, ::-1],
    "top to bottom": lambda image: image[::-1],
    "by half a turn": lambda image: image[::-1, ::-1],
}
LEAST_CORRELATION, UNRELATED = 0.15, 0.12
"""Below the first nothing is judged; below the second photos show something else. Path-traced colons have .7
(.5 with 1 % of noise), a painted smooth cylinder .17, photos of other frames .04 to .16."""
LEAST_OFFSET = 0.5
"""Twice the quarter of a pixel by which textures and shadows beside the rims move a whole sequence."""
RIM = 0.12  # jump of ln z between neighbouring pixels
RIM_SEARCH = 8.0  # pixels either side
DARK, BRIGHT = 12, 235


@dataclass(frozen=True)
class Registration:
    """How photos lie on depth maps.

    Attributes:
        correlation: of photo and predicted shading, as the files pair them; NaN where it was not judged.
        flip, shift: under which way to mirror photos, and with the photo of which later frame, they fit best.
        best: the correlation then.
        offset: float64 [2], px: where photos lie beside their depth maps; ``error`` [2] its standard error.
            NaN where there are too few rims.
        All are NaN for pictures so small that none can be moved against another.
    """

    correlation: float
    flip: str
    shift: int
    best: float
    offset: np.ndarray
    error: np.ndarray

    @property
    def judged(self) -> bool:
        """Whether photo and depth correlate at all."""
        return self.best > LEAST_CORRELATION

    @property
    def unrelated(self) -> bool:
        """Whether photos show something else than depth maps do."""
        return self.best < UNRELATED

    @property
    def off_centre(self) -> bool:
        """Whether photos lie beside their depth maps."""
        length = float(np.linalg.norm(self.offset))
        return length > LEAST_OFFSET + 2 * float(np.linalg.norm(self.error))


def registration(sequence: Sequence, frames: np.ndarray) -> Registration:
    """Judge a few of ``frames`` [F] and their neighbours in time."""
    stride = _stride(sequence.camera.width)
    if min(sequence.camera.width, sequence.camera.height) < LEAST_SIDE * stride:
        return Registration(np.nan, "none", 0, np.nan, np.full(2, np.nan), np.full(2, np.nan))
    centre = frames[spread(len(frames), FRAMES)]
    wanted = sorted({f + k for f in centre.tolist() for k in SHIFTS if 0 <= f + k < len(sequence)})
    photos = dict(zip(wanted, ahead(lambda f: reduced_photo(sequence.color(f)), wanted, 2), strict=True))
    shadings = dict(
        zip(centre.tolist(), ahead(lambda f: shading_of(sequence, f), centre.tolist(), 2), strict=True)
    )

    def peak(flip: str, shift: int) -> tuple[float, np.ndarray, list[float]]:
        """Correlation at the best offset common to all frames, that offset in reduced pixels, and each
        frame's own."""
        pairs = [(photos[f + shift], shade) for f, shade in shadings.items() if f + shift in photos]
        maps = [correlation_map(FLIPS[flip](photo), shade) for photo, shade in pairs]
        if not maps:
            return 0.0, np.zeros(2, int), []
        mean = np.mean(maps, axis=0)
        row, column = np.unravel_index(mean.argmax(), mean.shape)
        return float(mean.max()), np.array([column, row]) - REACH, [m[row, column] for m in maps]

    ways = {(flip, 0): peak(flip, 0) for flip in FLIPS} | {("none", k): peak("none", k) for k in SHIFTS[1:]}
    written, best = ("none", 0), max(ways, key=lambda way: ways[way][0])
    if not _clearly_better(ways[best], ways[written]):
        best = written
    offset, error = np.full(2, np.nan), np.full(2, np.nan)
    if ways[best][0] > LEAST_CORRELATION:
        start = ways[best][1] * stride
        placed = [frame for frame in centre.tolist() if 0 <= frame + best[1] < len(sequence)]
        offset, error = _offset_of(sequence, placed, best, start.astype(float))
    return Registration(ways[written][0], *best, ways[best][0], offset, error)


def _clearly_better(way: tuple, other: tuple) -> bool:
    """By a wide margin, or by a small one that nearly every frame shows."""
    if way[0] - other[0] > 0.15:
        return True
    if len(way[2]) < 4 or way[0] - other[0] < 0.01:
        return False
    return np.median(way[2]) - np.median(other[2]) > 0.01 and min(way[2]) > np.median(other[2])


def brightest(color: np.ndarray) -> np.ndarray:
    """The largest channel of a photo uint8 [H, W, 3], uint8 [H, W]."""
    return np.maximum(np.maximum(color[..., 0], color[..., 1]), color[..., 2])


def reduced_photo(color: np.ndarray) -> np.ndarray:
    """High-passed log brightness on the reduced grid, float32 [h, w]; 0 where dark, clipped or unknown."""
    stride = _stride(color.shape[1])
    grey = brightest(color)
    darkest = np.minimum(np.minimum(color[..., 0], color[..., 1]), color[..., 2])
    lit = ((grey > DARK) & (darkest < BRIGHT)).astype(np.uint8)
    level = grey.astype(np.float32)
    if stride > 1:
        level, lit = cv2.blur(level, (stride, stride)), cv2.erode(lit, np.ones((stride, stride), np.uint8))
    return _high_pass(np.log(np.maximum(level[::stride, ::stride], 8)), lit[::stride, ::stride] > 0)


def shading_of(sequence: Sequence, frame: int) -> np.ndarray:
    """``reduced_shading`` of a frame's depth map."""
    depth_mm, rays = sequence.depth_mm(frame), sequence.camera.pixel_directions
    return reduced_shading(depth_mm, rays, prepared(depth_mm, rays[..., 2]).noise)


def reduced_shading(depth_mm: np.ndarray, rays: np.ndarray, noise: float) -> np.ndarray:
    """High-passed log shading that z-depth [H, W] predicts, float32 [h, w] on the reduced grid; 0 unknown.

    Depth with a relative ``noise`` that would spoil its normals is smoothed first.
    """
    stride = _stride(depth_mm.shape[1])
    if noise > QUIET:
        known = np.isfinite(depth_mm)
        radius = noise / QUIET / 5
        weight = np.maximum(cv2.GaussianBlur(known.astype(np.float32), (0, 0), radius), 1e-3)
        smooth = cv2.GaussianBlur(np.where(known, depth_mm, 0), (0, 0), radius) / weight
        depth_mm = np.where(known, smooth, np.nan)
    z, ray = depth_mm[::stride, ::stride], rays[::stride, ::stride]
    with np.errstate(all="ignore"):
        points = ray * (z / ray[..., 2])[..., None]
        normal = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
        cosine = np.abs((normal * ray).sum(axis=2)) / np.linalg.norm(normal, axis=2)
        level = np.log(np.clip(cosine, 0.1, 1)) + 4 * np.log(ray[..., 2]) - 2 * np.log(z)
    return _high_pass(level, np.isfinite(level) & (ray[..., 2] > LEAST_COSINE))


def correlation_map(photo: np.ndarray, shading: np.ndarray) -> np.ndarray:
    """Correlation [2·REACH+1, 2·REACH+1] of a photo moved against the shading; zero offset in the middle."""
    inner = shading[REACH:-REACH, REACH:-REACH]
    if not inner.std() or not photo.std():
        return np.zeros((2 * REACH + 1, 2 * REACH + 1), np.float32)
    return cv2.matchTemplate(np.ascontiguousarray(photo), inner, cv2.TM_CCOEFF_NORMED)


def correlation(photo: np.ndarray, shading: np.ndarray) -> float:
    """Correlation of a photo and a shading where both are known; NaN where they share nothing."""
    both = (photo != 0) & (shading != 0)
    a, b = photo[both], shading[both]
    if len(a) < 100 or not a.std() or not b.std():
        return np.nan
    return float(np.corrcoef(a, b)[0, 1])


def _offset_of(
    sequence: Sequence, frames: list[int], way: tuple[str, int], start: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where photos lie beside their depth [2], by the rims of ``frames``, and its standard error [2]."""

    def measured(frame: int) -> np.ndarray:
        photo = FLIPS[way[0]](sequence.color(frame + way[1]))
        return rim_offset(np.ascontiguousarray(photo), sequence.depth_mm(frame), start)

    offsets = np.array(list(ahead(measured, frames, 2))).reshape(-1, 2)
    offsets = offsets[np.isfinite(offsets).all(axis=1)]
    if len(offsets) < 3:
        return np.full(2, np.nan), np.full(2, np.nan)
    middle = np.median(offsets, axis=0)
    spread = np.array([robust_std(offset) for offset in (offsets - middle).T])
    return middle, np.maximum(1.25 * spread / np.sqrt(len(offsets)), 0.02)


def rim_offset(color: np.ndarray, depth_mm: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Where a photo's dark edges lie beside the depth map's jumps, float64 [2] px; NaN for too few rims.

    Each edge tells the offset along its normal; a common widening of all rims (the fold's own shading) is
    fitted along. ``start`` [2] is a first guess.
    """
    log_z = np.log(np.where(np.isfinite(depth_mm) & (depth_mm > 0), depth_mm, np.nan))
    places, normals = _rims(log_z)
    if len(places) < 100:
        return np.full(2, np.nan)
    level = cv2.GaussianBlur(np.log(np.maximum(brightest(color), 6).astype(np.float32)), (0, 0), 1.0)
    along = np.arange(-RIM_SEARCH, RIM_SEARCH + 0.1, 0.25, np.float32)
    uv = (places + start)[:, None] + normals[:, None] * along[:, None]
    profile = _sampled(level, uv)
    darkening = -np.gradient(profile, 0.25, axis=1)
    darkening[~np.isfinite(darkening)] = -1
    best = np.clip(darkening.argmax(axis=1), 1, len(along) - 2)
    row = np.arange(len(best))
    left, middle, right = (darkening[row, best + k] for k in (-1, 0, 1))
    with np.errstate(all="ignore"):
        position = along[best] + 0.125 * (left - right) / (left - 2 * middle + right)
    sharp = (middle > 0.05) & np.isfinite(position) & (np.abs(position) < RIM_SEARCH - 0.5)
    if sharp.sum() < 100:
        return np.full(2, np.nan)
    design = np.concatenate([normals[sharp], np.ones((sharp.sum(), 1))], axis=1)
    return start + _robust_solution(design, position[sharp])[:2]


def _rims(log_z: np.ndarray, most: int = 5000) -> tuple[np.ndarray, np.ndarray]:
    """Places [R, 2] between pixels where depth jumps, and unit normals [R, 2] towards the far side."""
    found = []
    for axis, shift in ((1, (0.5, 0.0)), (0, (0.0, 0.5))):
        with np.errstate(invalid="ignore"):
            v, u = np.nonzero(np.abs(np.diff(log_z, axis=axis)) > RIM)
        found.append(np.stack([u, v], axis=1) + shift)
    places = np.concatenate(found).astype(np.float32)
    if not len(places):
        return places, places
    places = places[:: max(len(places) // most, 1)]
    smooth = cv2.GaussianBlur(np.nan_to_num(log_z).astype(np.float32), (0, 0), 2.0)
    slopes = [cv2.Sobel(smooth, cv2.CV_32F, *order) for order in ((1, 0), (0, 1))]
    normals = np.stack([_sampled(slope, places[:, None])[:, 0] for slope in slopes], axis=1)
    length = np.linalg.norm(normals, axis=1)
    good = length > 1e-6
    return places[good], normals[good] / length[good, None]


def _robust_solution(design: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Least squares with Cauchy-like weights, 15 rounds."""
    weight = np.ones(len(values))
    for _ in range(15):
        weighted = design * weight[:, None]
        solution = np.linalg.solve(weighted.T @ design + 1e-6 * np.eye(3), weighted.T @ values)
        error = np.abs(values - design @ solution)
        weight = 1 / (1 + (error / (robust_std(error) + 0.05)) ** 2) ** 2
    return solution


def _sampled(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Bilinear values [R, K] of an image at pixels [R, K, 2]; NaN outside."""
    u, v = (np.ascontiguousarray(uv[..., k], np.float32) for k in (0, 1))
    return cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan)


def _stride(width: int) -> int:
    return max(round(width / GRID), 1)


def _high_pass(level: np.ndarray, known: np.ndarray) -> np.ndarray:
    """A level less its mean over about a tenth of the image, within ±1, a little smoothed; 0 unknown."""
    weight = known.astype(np.float32)
    radius = level.shape[1] / 64
    low = cv2.GaussianBlur(np.where(known, level, 0).astype(np.float32), (0, 0), radius)
    low /= np.maximum(cv2.GaussianBlur(weight, (0, 0), radius), 1e-3)
    high = np.where(known, np.clip(np.where(known, level, 0) - low, -1, 1), 0).astype(np.float32)
    return np.where(cv2.erode(weight, np.ones((3, 3))) > 0, high, 0).astype(np.float32)

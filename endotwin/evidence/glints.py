"""Where the light guides stand by what their mirror images say.

A pixel that outshines what its place shows in other photos lies where the surface is a mirror: the viewing
ray, mirrored there about the normal, meets the plane of the lens where the guide stands. Normals of a mesh
scatter these crossings, each alike about its guide, and tissue that is rough scatters them more: how far is
found beside the guides, and says what the crossings are worth.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from scipy.optimize import least_squares
from scipy.special import xlogy

from endotwin.pixels.samples import Samples
from endotwin.pixels.start import Start
from endotwin.surface import Surface
from endotwin.surface.vectors import dot

PIXELS = 500_000
"""Samples among which glints are sought, all of some vertices."""

OUTSHINES = 0.1
"""Display values, in green and in blue: those of tissue differ less than that from photo to photo."""

LEAST_PIXELS = 4
"""Fewer samples of a vertex do not tell what it shows when it does not shine."""

REACH = 0.36
"""Crossings are mapped so far about the lens, as a share of the median viewing distance."""

CELLS = 64
EXPOSED = 2
"""Rounds in which medians of places and of photos are found beside each other."""

STEEPEST = 0.1
"""Mirrored rays that run nearer to the plane of the lens cross it anywhere."""

SMOOTH, SPREAD, APART = 0.03, 0.075, 0.1
"""Of the map, of crossings about a guide, and between guides, as shares of the map's width: where the search
for the best starts."""

LEAST_SEEN = 1e-3
"""The share of pixels in the fullest cell below which one says nothing."""

LEAST_RATE = 1e-6

MOST_GUIDES = 3

PLACES_A_GUIDE = 3.0
"""So many places of the tissue say as much of where a guide stands as all of its glints do: normals and lobes
err alike in these, and throw them all to one side of it."""

PLAIN, LEAST_GLINTS = 4.0, 100
"""Guides that leave so many times less of so many glints than light at the lens does are told by them.
Normals that err alike in many places pass for guides, too, but on random scenes left 39 % at least."""


class Glints:
    """Shares of pixels that outshine their place, by where their mirrored rays meet the plane of the lens.

    Attributes:
        x_mm: float [C], middles of the map's cells along each axis of the camera. shone, seen: float [C, C],
            number of glints and of pixels that cross at (x, y).
    """

    def __init__(self, x_mm: np.ndarray, shone: np.ndarray, seen: np.ndarray):
        self.x_mm, self.shone, self.seen = x_mm, shone, seen
        self._best = cache(self._found)

    @classmethod
    def of(cls, samples: Samples, surface: Surface, start: Start) -> Glints:
        """Glints among ``samples``, clipped ones included, beside the diffuse light of ``start``."""
        vertex = samples.nearest(surface.triangles)
        some = vertex % max(1, len(samples) // PIXELS) == 0
        samples, vertex = samples[torch.from_numpy(some)], vertex[some]
        at_mm, steep = crossings_mm(samples, surface)
        told, shines = outshining(samples, vertex, start)
        told &= steep
        reach_mm = REACH * samples.distance_mm
        edges = np.linspace(-reach_mm, reach_mm, CELLS + 1)
        shone, seen = (np.histogram2d(*at_mm[rows].T, (edges, edges))[0] for rows in (told & shines, told))
        return cls((edges[1:] + edges[:-1]) / 2, shone, seen)

    def guides_mm(self, number: int) -> np.ndarray:
        """So many positions that explain the glints best, [number, 3] in the camera frame; [0, 3] if there
        are no glints."""
        if not self.shone.any():
            return np.zeros((0, 3))
        return np.c_[self._best(number)[0], np.zeros(number)]

    def residuals(self, guides_mm: np.ndarray, place_pixels: float) -> np.ndarray:
        """Residuals [C²] of the number of glints under guides at ``guides_mm`` [K, 3], about which they
        spread as about the best K; beside those of pixels, of which a place of the tissue has so many."""
        if not self.shone.any():
            return np.zeros(self.shone.size)
        _, spread_mm, rates = self._best(len(guides_mm))
        weight = min(1.0, PLACES_A_GUIDE * len(guides_mm) * place_pixels / self.shone.sum())
        return np.sqrt(weight) * self._residuals(np.asarray(guides_mm)[:, :2], spread_mm, rates)

    def told(self) -> int:
        """The least number of guides that glints plainly tell of; 0: of none."""
        numbers = range(1, MOST_GUIDES + 1)
        return next((number for number in numbers if self.tell(self.guides_mm(number))), 0)

    def tell(self, guides_mm: np.ndarray) -> bool:
        """Whether glints plainly stand about guides at ``guides_mm`` [K, 3], and not about the lens."""
        if self.shone.sum() < LEAST_GLINTS:
            return False
        about_lens = self._residuals(*self._best(0))
        about_guides = self._residuals(np.asarray(guides_mm)[:, :2], *self._best(len(guides_mm))[1:])
        return float((about_lens**2).sum()) > PLAIN * float((about_guides**2).sum())

    def _residuals(self, guides_mm: np.ndarray, spread_mm: float, rates: np.ndarray) -> np.ndarray:
        """Deviance residuals [C²] of Poisson numbers of glints with one rate anywhere and more about each
        guide [K, 2], both in ``rates``: half their squares are negative log-likelihoods."""
        along = np.exp(-(((self.x_mm - guides_mm[..., None]) / spread_mm) ** 2) / 2)
        mean = self.seen * (rates[0] + rates[1] * np.einsum("kx,ky->xy", along[:, 0], along[:, 1]))
        mean = np.maximum(mean, np.finfo(float).tiny)
        deviance = mean - self.shone + xlogy(self.shone, self.shone / mean)
        return (np.sign(self.shone - mean) * np.sqrt(2 * np.maximum(deviance, 0))).ravel()

    def _found(self, number: int) -> tuple[np.ndarray, float, np.ndarray]:
        """Guides [number, 2] in mm, or the lens [1, 2] for none; the spread of crossings about them, mm; and
        the rates elsewhere and about them."""
        scale_mm = 2 * abs(float(self.x_mm[0]))
        peaks_mm, rate = self._peaks(number, scale_mm)

        def plain(x: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
            at_mm = scale_mm * x[:-3].reshape(-1, 2) if number else np.zeros((1, 2))
            return at_mm, scale_mm * np.exp(x[-3]), np.exp(x[-2:])

        first = np.r_[peaks_mm.ravel() / scale_mm, np.log([SPREAD, self.shone.sum() / self.seen.sum(), rate])]
        bounds = [(-0.5, 0.5)] * (2 * number) + [np.log([0.5 / CELLS, 1]), *[np.log([LEAST_RATE, 1])] * 2]
        bounds = np.transpose(bounds)
        found = least_squares(lambda x: self._residuals(*plain(x)), np.clip(first, *bounds), bounds=bounds)
        return plain(found.x)

    def _peaks(self, number: int, scale_mm: float) -> tuple[np.ndarray, float]:
        """The highest peaks [number, 2], mm, of the smoothed rate, apart from each other, and the rate at the
        first."""
        smooth = [gaussian_filter(each, SMOOTH * CELLS) for each in (self.shone, self.seen)]
        rate = smooth[0] / np.maximum(smooth[1], LEAST_SEEN * smooth[1].max())
        peaks_mm, left = [], rate
        for _ in range(number):
            peak_mm = self.x_mm[list(np.unravel_index(left.argmax(), left.shape))]
            near = [np.exp(-(((self.x_mm - x) / (APART * scale_mm)) ** 2) / 2) for x in peak_mm]
            peaks_mm.append(peak_mm)
            left = left * (1 - np.multiply.outer(*near))
        return np.array(peaks_mm), float(rate.max())


def crossings_mm(samples: Samples, surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Where N viewing rays, mirrored about the surface's normals, meet the plane of the lens: x and y in the
    camera frame [N, 2]; and which are steep enough to tell, bool [N]."""
    normals, view, points_mm = samples.normals(surface), samples.directions, samples.points_mm
    mirrored = view - 2 * dot(view, normals)[:, None] * normals
    down = np.minimum(mirrored[:, 2], -STEEPEST)
    at_mm = points_mm - (points_mm[:, 2] / down)[:, None] * mirrored
    return at_mm[:, :2], mirrored[:, 2] <= -STEEPEST


def outshining(samples: Samples, vertex: np.ndarray, start: Start) -> tuple[np.ndarray, np.ndarray]:
    """Of which samples their ``vertex`` [N] tells what it shows without a glint, the median of its photos
    under the light of ``start`` and each photo's own exposure; and which outshine that, both bool [N]."""
    light = start.light
    log_light = light.n * samples.log_cos_axis - light.q * samples.log_distance + samples.cos.log()
    level = start.response.gamma * log_light.numpy()
    shown = samples.color[:, 1:].amin(dim=1).clamp_min(1).numpy().astype(np.float32) / 255
    albedo = np.log(shown) - level
    told = np.bincount(vertex, minlength=1)[vertex] >= LEAST_PIXELS
    view = samples.views.row(samples.frame)
    exposure = np.zeros(len(samples.views.frames), np.float32)
    for _ in range(EXPOSED):
        middle = _medians(albedo - exposure[view], vertex)
        exposure = _medians((albedo - middle[vertex])[told], view[told], len(exposure))
    expected = middle[vertex] + exposure[view] + level
    return told, shown - np.exp(expected) > OUTSHINES


def _medians(values: np.ndarray, group: np.ndarray, count: int = 0) -> np.ndarray:
    """The lower median of ``values`` [N] in each ``group`` [N], float32 [count] or as many as there are; 0
    where there are none.

    One sort of both as one number takes a quarter of the time of one by two keys.
    """
    size = np.bincount(group, minlength=count)
    middle = np.zeros(len(size), np.float32)
    there = size > 0
    least, most = float(values.min(initial=0)), float(values.max(initial=0))
    first = 2 * (most - least) * np.arange(len(size))
    placed = np.sort(first[group] + (values - least))
    middle[there] = placed[(np.cumsum(size) - (size + 1) // 2)[there]] - first[there] + least
    return middle

"""Sparkles from photos: how many small highlights the film misses, where, how bright, and for how long.

They are counted in photos from which no film was found, beside a film from the others. Facets that shine are
a marked Poisson process: where the half vector has the slope s, ρ·P(s)·πα² of them a mm² are within their own
lobe's width α of it, and of those whose mean peak is B̄ the share E₁(T/B̄) outshines T (a Gaussian lobe of an
exponential size). Its likelihood tells ρ on the film and elsewhere, the spread of P, and B̄; which sparkles
the next photo still shows tells α.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from scipy import ndimage
from scipy.optimize import minimize
from scipy.special import exp1, xlogy

from endotwin.cameras.base import solid_angle
from endotwin.effects import Decision, unjudged
from endotwin.effects.sparkle import Sparkle
from endotwin.fit.beneath import APART, GLINT, Model
from endotwin.fit.film import Found as FoundFilm
from endotwin.fit.film import Report
from endotwin.fit.heal import REACH_PX
from endotwin.light import shading
from endotwin.light.film import Film, mirrors, mirrors_in_view
from endotwin.pixels.samples import CLIPPED, Samples, Views
from endotwin.run.ahead import ahead
from endotwin.run.threads import THREADS
from endotwin.sequence.spread import spread
from endotwin.surface.rows import Rows
from endotwin.surface.silhouettes import dilated
from endotwin.surface.vectors import dot, unit

PHOTOS = 6
"""In so many of the photos kept apart sparkles are counted, and followed into the next one."""

LARGEST_PX = 64
"""Area of the largest sparkle: a wider highlight is the film's, or an error's."""

LEAST = 30
"""Fewer sparkles tell too little of where they stand."""

LEAST_NATS = 5.0
"""Of log-likelihood by which they must stand on the film and where it mirrors, rather than anywhere."""

STEEPEST = 60.0
"""Degrees between half vector and normal beyond which a normal is a rim's, and tells nothing."""

PLACES = 20_000
"""Pixels of a photo by which it is integrated over."""

NEAR_PX, ABOUT_PX = 2, 6
"""Where a sparkle is looked for in another photo, and what is about it."""

START = 0.36, 0.1
"""Spread (α) and mean peak, radiance, to start from."""

ROUGHNESSES = np.geomspace(0.045, 0.5, 60)
RADII = np.linspace(0.02, 4, 200)
"""Of the disks in which facets shine, in widths of their lobe."""

CERTAIN = 0.02, 0.98
"""No more certain than that is whether a sparkle stays: poses err, and another may take its place."""

Slopes = Callable[[np.ndarray, float], np.ndarray]


def sparkle(wet: FoundFilm, views: Views, wanted: str, report: Report) -> tuple[Sparkle | None, Decision]:
    """The sparkles that ``views`` show beside a film, or that are ``wanted`` (auto, on or off); and why."""
    if wanted == "off":
        return None, unjudged(wanted)
    if wet.film is None and wanted == "auto":
        return None, Decision("off", "no film of fluid, whose facets they are")
    if len(views.frames) <= APART // 2:
        return None, Decision("off", "too few photos to keep some apart")
    began = time.perf_counter()
    found = _Found.of(wet, views, report)
    told = len(found) >= LEAST
    effect, nats = found.measured(views.camera.height) if told else (Sparkle(weight=0.0), 0.0)
    reason = f"{len(found)} small highlights of {found.area_mm2 / 100:.0f} cm² of photos are not the film's"
    if told:
        reason += f", {effect.density:.2g} facets a mm², on the film and where it mirrors by {nats:.0f} nats"
    state = "on" if wanted == "on" or (told and nats > LEAST_NATS) else "off"
    reason = f"forced on; {reason}" if wanted == "on" else reason
    decision = Decision(state, reason, fit_s=round(time.perf_counter() - began, 3))
    return effect if state == "on" else None, decision


@dataclass(frozen=True)
class _Photo:
    """A photo beside what the model shows.

    Attributes:
        samples: its pixels, N. excess: float32 [H, W], radiance beyond model and film, the lesser of green
            and blue; NaN where no pixel counts. least: float32 [N], radiance of a glint. dry: bool [N],
            pixels about which no film shines.
    """

    samples: Samples
    excess: np.ndarray
    least: np.ndarray
    dry: np.ndarray

    @classmethod
    def of(cls, model: Model, views: Views, row: int, wet: FoundFilm | None) -> _Photo:
        """That of ``row`` among the ``views``."""
        based, gamma = model.photo(views, row), model.state.shared.gamma
        samples, beyond = based.samples, based.radiance
        if wet is not None and wet.apart is not None:
            beyond = beyond + model.shining(samples, row, wet.apart, wet.effect.roughness)
        shown = shading.respond(beyond, gamma).numpy()
        least = shading.radiance_of(shown + GLINT, gamma) - beyond.numpy()
        excess = shading.radiance_of(based.shown.numpy(), gamma) - beyond.numpy()
        shape, pixel = views.lens_mask.shape, samples.pixel.numpy()
        filmed = np.zeros(shape, bool)
        filmed.flat[pixel[(shown - based.predicted().numpy())[:, 1:].min(axis=1) > GLINT]] = 1
        image = np.full(shape, np.nan, np.float32)
        image.flat[pixel] = excess[:, 1:].min(axis=1)
        return cls(samples, image, least[:, 1:].max(axis=1), ~dilated(filmed, REACH_PX).flat[pixel])

    def sparkles(self) -> tuple[np.ndarray, np.ndarray]:
        """Small highlights, M of them: the sample at the top of each, int [M], and its area, px [M]."""
        pixel, shape = self.samples.pixel.numpy(), self.excess.shape
        top = self.excess.flat[pixel]
        number, glints = np.zeros(shape, np.int64), np.zeros(shape, np.uint8)
        number.flat[pixel], glints.flat[pixel] = np.arange(len(pixel)), (top > self.least) & self.dry
        count, label, stats, _ = cv2.connectedComponentsWithStats(glints)
        area = stats[:, cv2.CC_STAT_AREA]
        small = [k for k in range(1, count) if area[k] <= LARGEST_PX]
        at = ndimage.maximum_position(np.nan_to_num(self.excess), label, small)
        return np.array([number[place] for place in at], np.int64), area[small]

    def local(self, uv: np.ndarray) -> np.ndarray:
        """By how much the brightest pixel near ``uv`` [M, 2] outshines those about it, [M]; NaN where the
        photo does not tell."""
        off = np.arange(-ABOUT_PX, ABOUT_PX + 1)
        column, row = (np.rint(np.nan_to_num(uv, nan=-1e6)).astype(np.int64)[:, :, None] + off).swapaxes(0, 1)
        inside = ((column >= 0) & (column < self.excess.shape[1])).all(axis=1)
        inside &= ((row >= 0) & (row < self.excess.shape[0])).all(axis=1)
        found = np.full(len(uv), np.nan, np.float32)
        if not inside.any():
            return found
        about = self.excess[row[inside][:, :, None], column[inside][:, None]]
        near = slice(ABOUT_PX - NEAR_PX, ABOUT_PX + NEAR_PX + 1)
        found[inside] = about[:, near, near].max(axis=(1, 2)) - np.median(about, axis=(1, 2))
        return found


@dataclass(frozen=True, eq=False)
class _Places(Rows):
    """How pixels stand to K guides.

    Attributes:
        slope2: [N, K], squared slope of the half vector about the surface's normal. cos_i, gain: [N, K],
            n·ωi, and what B̄ is of for a Smith factor and a coefficient of 1. cos_o, least, area_mm2: [N].
            wet: bool [N], those on the film; all of them without one.
    """

    slope2: np.ndarray
    cos_i: np.ndarray
    gain: np.ndarray
    cos_o: np.ndarray
    least: np.ndarray
    area_mm2: np.ndarray
    wet: np.ndarray

    @classmethod
    def of(cls, model: Model, photo: _Photo, index: np.ndarray, film: Film | None) -> _Places:
        """Of the samples ``index`` [N] of a photo."""
        samples, shared = photo.samples[torch.from_numpy(index)], model.state.shared
        points_mm, normals = samples.points_mm, samples.normals(model.twin.surface)
        guides_mm, profile = model.guides_mm, model.relighting.effects.profile
        half, strength = mirrors(points_mm, guides_mm, profile, shared.log_light)
        cos_m = np.einsum("na,nka->nk", normals, half).clip(1e-3, 1)
        cos_o = dot(normals, unit(-points_mm)).clip(1e-3, 1)
        cos_i = samples.cos[:, None] if samples.guides is None else samples.guides.cos_i
        seen_mm2 = dot(points_mm, points_mm) * solid_angle(samples.views.camera, _uv(samples))
        gain = (
            strength.numpy() * cos_i.numpy() * (cos_o / seen_mm2)[:, None] * model.exposure(samples).numpy()
        )
        gain = shading.F0_WATER * gain / cos_m**4
        corners = model.twin.surface.triangles[samples.triangle.numpy()]
        wet = np.ones(len(index), bool) if film is None else film.wets(corners)
        return cls(1 / cos_m**2 - 1, cos_i.numpy(), gain, cos_o, photo.least[index], seen_mm2 / cos_o, wet)

    @property
    def flat(self) -> np.ndarray:
        """Bool [N], whose nearest mirror direction is no steeper than STEEPEST."""
        return self.slope2.min(axis=1) < math.tan(math.radians(STEEPEST)) ** 2

    def mean_peak(self, spread: float, coefficient: float) -> np.ndarray:
        """B̄, [N, K]."""
        cos_i, cos_o = torch.from_numpy(self.cos_i), torch.from_numpy(self.cos_o)[:, None]
        visibility = shading.smith_visibility(cos_i, cos_o, torch.tensor(spread)).numpy()
        return np.maximum(coefficient * self.gain * visibility, 1e-12)


def _uv(samples: Samples) -> np.ndarray:
    row, column = np.divmod(samples.pixel.numpy(), samples.views.camera.width)
    return np.stack([column, row], axis=1).astype(np.float64)


def _ggx_slopes(slope2: np.ndarray, spread: float) -> np.ndarray:
    """Distribution of slopes whose microfacets have GGX's (Heitz 2014)."""
    return spread**2 / (math.pi * (spread**2 + slope2) ** 2)


def _evenly(slope2: np.ndarray, spread: float) -> np.ndarray:
    """Facets that face anywhere."""
    return np.ones_like(slope2)


@dataclass(frozen=True, eq=False)
class _Found:
    """M sparkles of some photos.

    Attributes:
        at, all: how each stands to the guides, and pixels all over the photos, whose areas add up to theirs.
        peak: [M], radiance. clipped: bool [M], those that may be brighter. area_px: [M]. turn, after: [M],
            by how much the half vector turned until the next photo, rad, and the peak that is left there;
            NaN where that does not tell.
    """

    at: _Places
    all: _Places
    peak: np.ndarray
    clipped: np.ndarray
    area_px: np.ndarray
    turn: np.ndarray
    after: np.ndarray

    def __len__(self) -> int:
        return len(self.peak)

    @property
    def area_mm2(self) -> float:
        return float(self.all.area_mm2.sum())

    @classmethod
    def of(cls, wet: FoundFilm, views: Views, report: Report) -> _Found:
        """Those of some of the photos kept apart."""
        rows = np.arange(APART // 2, len(views.frames), APART)
        rows = rows[spread(len(rows), PHOTOS)]
        parts = []

        def one(row: int) -> _Found:
            return cls._of_photo(wet, views, row)

        for done, part in enumerate(ahead(one, rows, THREADS), 1):
            parts.append(part)
            report("count the sparkles", done, len(rows))
        return _joined(parts)

    @classmethod
    def _of_photo(cls, wet: FoundFilm, views: Views, row: int) -> _Found:
        model = wet.model
        photo = _Photo.of(model, views, row, wet)
        index, area_px = photo.sparkles()
        at = _Places.of(model, photo, index, wet.apart)
        flat = at.flat
        index, area_px, at = index[flat], area_px[flat], at[flat]
        samples = photo.samples[torch.from_numpy(index)]
        peak = np.maximum(photo.excess.flat[samples.pixel.numpy()], photo.least[index])
        count = min(PLACES, len(photo.samples))
        places = np.random.default_rng(row).choice(len(photo.samples), count, replace=False)
        everywhere = _Places.of(model, photo, places, wet.apart)
        everywhere = everywhere[everywhere.flat & photo.dry[places]]
        area_mm2 = everywhere.area_mm2 * (len(photo.samples) / max(1, count))
        everywhere = replace(everywhere, area_mm2=area_mm2)
        other = row + 1 if row + 1 < len(views.frames) else row - 1
        turn, after = _followed(model, samples, views, row, other) if len(index) else (peak, peak)
        clipped = samples.color[:, 1:].amin(dim=1).numpy() >= CLIPPED
        return cls(at, everywhere, peak, clipped, area_px, turn, after)

    def measured(self, height: int) -> tuple[Sparkle, float]:
        """The sparkles of photos ``height`` px high, and the log-likelihood by which facets on the film, and
        about the normals of the surface, explain them better than facets anywhere that face anywhere."""
        bounds = {each.name: (each.low, each.high) for each in Sparkle.parameters()}

        def unpacked(log: np.ndarray) -> tuple[float, float]:
            spread, coefficient = np.exp(np.clip(log, -20, 20))
            return float(np.clip(spread, *np.square(bounds["spread"]))), float(coefficient)

        even = minimize(
            lambda log: self._cost(START[0], math.exp(log[0]), _evenly, 1)[0],
            np.log(START[1:]),
            method="Nelder-Mead",
        )
        best = minimize(
            lambda log: self._cost(*unpacked(log), _ggx_slopes, 2)[0], np.log(START), method="Nelder-Mead"
        )
        spread, coefficient = unpacked(best.x)
        shining, dry = self._cost(spread, coefficient, _ggx_slopes, 2)[1]
        sigma2_px = self.area_px.sum() / np.log(self.peak / self.at.least).sum() / (2 * math.pi)
        width = self._width(spread, coefficient)
        values = {
            "weight": coefficient * shining * 2 * math.pi * sigma2_px,
            "density": shining / (math.pi * width**2),
            "dry": dry / max(shining, 1e-30),
            "spread": math.sqrt(spread),
            "roughness": math.sqrt(width),
            "size": math.sqrt(sigma2_px) / height,
        }
        bounded = {name: float(np.clip(value, *bounds[name])) for name, value in values.items()}
        return Sparkle(**bounded), float(even.fun - best.fun)

    def _cost(
        self, spread: float, coefficient: float, slopes: Slopes, parts: int
    ) -> tuple[float, np.ndarray]:
        """Negative log-likelihood of facets whose slopes lie so and whose mean peaks have that coefficient;
        and the ρπα² of each of the ``parts`` of the surface, 2: film and elsewhere, for which it is least."""
        peak = self.all.mean_peak(spread, coefficient)
        rate = (slopes(self.all.slope2, spread) * exp1(self.all.least[:, None] / peak)).sum(axis=1)
        dry, dry_at = ((parts - 1) * ~each.wet for each in (self.all, self.at))
        expected = np.bincount(dry, self.all.area_mm2 * rate, parts).clip(1e-30)
        count = np.bincount(dry_at, minlength=parts)
        mean, mark = self.at.mean_peak(spread, coefficient), self.peak[:, None]
        density = np.where(self.clipped[:, None], exp1(mark / mean), np.exp(-mark / mean) / mark)
        density = (slopes(self.at.slope2, spread) * density).sum(axis=1)
        log = np.log(np.maximum(density, 1e-300)).sum() + xlogy(count, count / expected).sum()
        return -float(log), count / expected

    def _width(self, spread: float, coefficient: float) -> float:
        """α of a facet's lobe, by which sparkles are still seen in the next photo.

        One of peak B shines where the half vector lies within α·√ln(B/T) of its middle: that it does for two
        half vectors a turn apart is the part that two such disks share, over exponential B.
        """
        told = np.isfinite(self.after)
        if not told.any():
            return Sparkle().roughness ** 2
        at, turn, stays = self.at[told], self.turn[told], (self.after > self.at.least)[told]
        nearest = at.slope2.argmin(axis=1)[:, None]
        mean = np.take_along_axis(at.mean_peak(spread, coefficient), nearest, axis=1)
        chance = (at.least[:, None] / mean) * np.exp(RADII**2)
        chance = np.exp(-chance) * chance * RADII
        costs = []
        for width in ROUGHNESSES**2:
            half = np.minimum(turn[:, None] / width / (2 * RADII), 1)
            shared = 2 / math.pi * (np.arccos(half) - half * np.sqrt(1 - half**2))
            kept = (chance * RADII**2 * shared).sum(axis=1) / (chance * RADII**2).sum(axis=1).clip(1e-300)
            kept = kept.clip(*CERTAIN)
            costs.append(-np.log(np.where(stays, kept, 1 - kept)).sum())
        return float(ROUGHNESSES[int(np.argmin(costs))] ** 2)


def _followed(
    model: Model, samples: Samples, views: Views, row: int, other: int
) -> tuple[np.ndarray, np.ndarray]:
    """By how much the half vector of ``samples`` [M] of one view turns until another, rad, and how much the
    photo there outshines what is about them, both [M]."""
    surface, camera = model.twin.surface, views.camera
    corners = surface.vertices_mm[surface.triangles[samples.triangle.numpy()]]
    points_mm = np.einsum("nk,nka->na", samples.barycentric.numpy(), corners)
    effects, halves = model.relighting.effects, []
    for view in (row, other):
        pose = views.T_local_camera[view]
        more = model.guides_mm, effects.profile, model.state.shared.log_light, None
        halves.append(mirrors_in_view(points_mm, pose, *more)[0])
    normals = np.einsum("nab,nb->na", samples.rotation, samples.normals(surface))
    nearest = np.einsum("na,nka->nk", normals, halves[0]).argmax(axis=1)
    here, there = (half[np.arange(len(nearest)), nearest] for half in halves)
    across = np.cross(here, there)
    uv = camera.project((points_mm - pose[:3, 3]) @ pose[:3, :3])
    return np.sqrt(dot(across, across)), _Photo.of(model, views, other, None).local(uv)


def _joined(parts: list):
    """Dataclasses of one kind, their arrays, and those of theirs, one after the other."""
    columns = {name: [getattr(part, name) for part in parts] for name in vars(parts[0])}
    return type(parts[0])(
        **{
            name: np.concatenate(each) if isinstance(each[0], np.ndarray) else _joined(each)
            for name, each in columns.items()
        }
    )

"""What a fit leaves of the photos unexplained, beside what their noise would leave."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import labeled_comprehension
from torch import Tensor

from endotwin.effects import Decision
from endotwin.effects.noise import LEVEL, Noise
from endotwin.pixels.casts import WIDTHS, told
from endotwin.pixels.samples import Samples
from endotwin.robust import NORMAL, robust_std
from endotwin.sequence import Sequence

FRAMES = 4
"""Photos in which the noise is measured."""

WORSE = 3.0
"""A fit that leaves so many times the photos' noise lacks something: textures finer than the mesh, and what a
codec adds, leave up to two."""

MIDDLE = (0.1, 0.9)
"""Display values at which colour is judged: below, rounding and noise have their say; above, clipping."""

LIMIT = 4.0
"""What a photo departs by counts, where its detail is judged, at most so many of the fit's own sigmas."""

CAST, BLURRED, FAR = 0.05, 0.85, 2.0
"""A photo has another colour than the rest where a channel is off by so much (ln of display values): that
alone keeps a photo of middle brightness below 37 dB, −20·log₁₀(0.05·0.5/√3). It is blurred where it shows
less than this share of the detail, and amiss where it departs so many times as far from the fit."""


@dataclass(frozen=True, eq=False)
class Remains:
    """What a fit leaves of the training photos, F of them.

    Attributes:
        sigma: robust standard deviation of its residual, display values. sigmas: float64 [F], each photo's.
        casts: float64 [F, 3], by how much each photo's channels are brighter than what is shown: medians of
            ln(photo/shown) of display values. detail: float64 [F], how much each shows of the detail that all
            have told, 1 for all of it. NaN where no pixel is of middle brightness.
        frames: int [F], indices of those photos.
    """

    sigma: float
    sigmas: np.ndarray
    casts: np.ndarray
    detail: np.ndarray
    frames: np.ndarray

    @classmethod
    def of(cls, sigma: float, samples: Samples, shown: Tensor, coarse: Tensor) -> Remains:
        """What is left of ``samples`` where a fit shows ``shown`` [N, 3], ``coarse`` without its detail."""
        samples, shown, coarse = samples.to(torch.device("cpu")), shown.cpu().numpy(), coarse.cpu().numpy()
        judged = (shown > MIDDLE[0]) & (shown < MIDDLE[1])
        photo = np.maximum(samples.color.numpy(), 0.5) * LEVEL
        row, count = samples.views.row(samples.frame), len(samples.views.frames)

        def medians(values: np.ndarray, some: np.ndarray) -> np.ndarray:
            rows = np.broadcast_to(row.reshape(-1, *(1,) * (some.ndim - 1)), some.shape)[some]
            return labeled_comprehension(values[some], rows, np.arange(count), np.median, np.float64, np.nan)

        log_ratio, left = np.log(photo / shown.clip(*MIDDLE)), photo - shown
        casts = np.stack([medians(*each) for each in zip(log_ratio.T, judged.T, strict=True)], axis=1)
        detail = np.where(judged, shown - coarse, 0)
        beside_cast = photo - shown * np.exp(np.nan_to_num(casts))[row]
        seen = detail + beside_cast.clip(-LIMIT * sigma, LIMIT * sigma)
        told = [np.bincount(row, (detail * each).sum(axis=1), count) for each in (seen, detail)]
        share = np.divide(*told, out=np.full(count, np.nan), where=told[1] > 0)
        sigmas = NORMAL * medians(np.abs(left), judged)
        return cls(sigma, sigmas, casts, share, samples.views.frames)


def odd_photos_warning(remains: Remains) -> str | None:
    """A sentence on photos that are not like the others, and how to leave them out; None where all agree."""
    found = [each for each in (_cast(remains), _blurred(remains), _amiss(remains)) if each]
    if not found:
        return None
    said, odd = zip(*found, strict=True)
    frames = ",".join(map(str, remains.frames[np.unique(np.concatenate(odd))]))
    return f"{'; '.join(said)}; 'endotwin fuse --without {frames}' leaves out what is not like the rest"


Odd = tuple[str, np.ndarray]
"""A sentence on the photo that is most off, and the rows of all that are off so."""


def _cast(remains: Remains) -> Odd | None:
    """Photos of another colour: white light, one exposure or fitted gains, and one colour of each place,
    leave none."""
    known = np.isfinite(remains.casts)
    if not known.any(axis=0).all():
        return None
    off = remains.casts - np.nanmedian(remains.casts, axis=0)
    size = np.where(known, np.abs(off), 0.0)
    odd = np.flatnonzero(size.max(axis=1) > max(CAST, WIDTHS * robust_std(size[known])))
    if not len(odd):
        return None
    worst, channel = np.unravel_index(size.argmax(), size.shape)
    return (
        f"photo {remains.frames[worst]} is {told(off[worst, channel], channel)} than the other photos of the "
        "same places (was the white balance or the light another?)"
    ), odd


def _blurred(remains: Remains) -> Odd | None:
    """Photos that lack detail."""
    share = _beside_others(remains.detail)

    def says(worst: int) -> str:
        return (
            f"photo {remains.frames[worst]} shows {100 * max(share[worst], 0):.0f} % of the detail that the "
            "others do (is it blurred?)"
        )

    return _odd(1 - share, 1 - BLURRED, says)


def _amiss(remains: Remains) -> Odd | None:
    """Photos that the fit does not explain."""
    times = _beside_others(remains.sigmas)

    def says(worst: int) -> str:
        return (
            f"photo {remains.frames[worst]} departs from the fit {times[worst]:.1f} times as far as the "
            "others do (is the lens smeared, or its pose another?)"
        )

    return _odd(times - 1, FAR - 1, says)


def _beside_others(values: np.ndarray) -> np.ndarray:
    """Positive ``values`` [F] as shares of their median; NaN where there is none."""
    known = values[np.isfinite(values) & (values > 0)]
    return values / np.median(known) if known.size else np.full_like(values, np.nan)


def _odd(off: np.ndarray, least: float, says: Callable[[int], str]) -> Odd | None:
    """Photos that are ``off`` [F] by more than ``least`` and by more than WIDTHS of all that are known."""
    rows = np.flatnonzero(off > max(least, WIDTHS * robust_std(off[np.isfinite(off)])))
    return (says(rows[off[rows].argmax()]), rows) if len(rows) else None


def residual_warning(left: float, sequence: Sequence, decisions: Mapping[str, Decision]) -> str | None:
    """A sentence on a fit that leaves ``left`` (robust standard deviation, display values) of its photos.

    None where noise and rounding leave as much, or where no noise can be measured.

    The suspect is the effect, of those that are off, that came nearest to being kept.
    """
    noise = Noise.measured(sequence, FRAMES)
    if noise is None:
        return None
    expected = math.hypot(float(noise.sigma(0.5)), LEVEL / math.sqrt(12))
    if left <= WORSE * max(expected, LEVEL):
        return None
    off = {name: each.gain_db for name, each in decisions.items() if each.state == "off" and each.gain_db}
    suspect = max(off, key=off.get, default=None)
    hint = "" if suspect is None or off[suspect] <= 0 else f"suspect {suspect}, which is off, or "
    return (
        f"the fit leaves {left / LEVEL:.1f} of 255 levels of its photos unexplained, "
        f"{left / expected:.0f} times their noise: {hint}poses and depth that do not fit the photos"
    )

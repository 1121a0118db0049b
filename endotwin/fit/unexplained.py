"""What a fit leaves of the photos unexplained, beside what their noise would leave."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import labeled_comprehension
from torch import Tensor

from endotwin.effects import Decision
from endotwin.effects.noise import LEVEL, Noise
from endotwin.pixels.samples import Samples
from endotwin.robust import robust_std
from endotwin.sequence import Sequence

FRAMES = 4
"""Photos in which the noise is measured."""

WORSE = 3.0
"""A fit that leaves so many times the photos' noise lacks something: textures finer than the mesh, and what a
codec adds, leave up to two."""

MIDDLE = (0.1, 0.9)
"""Display values at which colour is judged: below, rounding and noise have their say; above, clipping."""

CAST = 0.05
CAST_WIDTHS = 5.0
"""A photo has another colour than the rest where a channel is off by so much (ln of display values), and by
so many times what those of the others are: that alone keeps a photo of middle brightness below 37 dB,
−20·log₁₀(0.05·0.5/√3)."""


@dataclass(frozen=True, eq=False)
class Remains:
    """What a fit leaves of the training photos.

    Attributes:
        sigma: robust standard deviation of its residual, display values.
        casts: float64 [F, 3], by how much each photo's channels are brighter than what is shown: medians of
            ln(photo/shown) of display values, NaN where no pixel is of middle brightness.
        frames: int [F], indices of those photos.
    """

    sigma: float
    casts: np.ndarray
    frames: np.ndarray

    @classmethod
    def of(cls, sigma: float, samples: Samples, shown: Tensor) -> Remains:
        """What is left of ``samples`` where a fit shows ``shown`` [N, 3]."""
        samples, shown = samples.to(torch.device("cpu")), shown.cpu().numpy()
        judged = (shown > MIDDLE[0]) & (shown < MIDDLE[1])
        photo = np.maximum(samples.color.numpy(), 0.5) * LEVEL
        log_ratio = np.log(photo / shown.clip(*MIDDLE))
        row, rows = samples.views.row(samples.frame), np.arange(len(samples.views.frames))
        casts = [
            labeled_comprehension(log_ratio[some, channel], row[some], rows, np.median, np.float64, np.nan)
            for channel, some in enumerate(judged.T)
        ]
        return cls(sigma, np.stack(casts, axis=1), samples.views.frames)


def cast_warning(remains: Remains) -> str | None:
    """A sentence on the photo whose colour departs most from what the fit shows, and how to leave it out with
    the others that do; None where all agree: white light, one exposure or fitted gains, and one colour of
    each place, leave none."""
    known = np.isfinite(remains.casts)
    if not known.any(axis=0).all():
        return None
    off = remains.casts - np.nanmedian(remains.casts, axis=0)
    size = np.where(known, np.abs(off), 0.0)
    width = robust_std(size[known])
    odd = np.flatnonzero(size.max(axis=1) > max(CAST, CAST_WIDTHS * width))
    if not len(odd):
        return None
    worst, channel = np.unravel_index(size.argmax(), size.shape)
    change = np.expm1(off[worst, channel])
    frames = ",".join(map(str, remains.frames[odd]))
    return (
        f"photo {remains.frames[worst]} is {100 * abs(change):.0f} % {'more' if change > 0 else 'less'} "
        f"{('red', 'green', 'blue')[channel]} than the other photos of the same places: was the white "
        f"balance or the light another? 'endotwin fuse --without {frames}' leaves out what is off so far"
    )


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

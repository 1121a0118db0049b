"""Photos of another white balance than the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from endotwin.effects.tone import Tone
from endotwin.pixels.samples import CLIPPED, Samples
from endotwin.robust import robust_std

WIDTHS = 5.0
"""What is off by so many times what the others are stands out."""

LEAST_CAST = 0.02
"""Where photos hardly vary otherwise, what a bounce errs by turns single ones by up to 0.016; and less costs
next to nothing."""

COLORS = ("red", "green", "blue")


@dataclass(frozen=True, eq=False)
class Casts:
    """By how much channels of photos are brighter than the other photos have them at the same places.

    Attributes:
        frames: int [F], the photos, ascending. log: float64 [F, 3], ln of the ratio of display values; 0 for
            green, beside which a camera's white balance amplifies red and blue.
    """

    frames: np.ndarray
    log: np.ndarray

    def taken_off(self, samples: Samples, tone: Tone | None = None) -> Samples:
        """The samples as photos of the others' white balance show them, if the camera sets it before the
        curve ``tone``. What is clipped stays so."""
        tone = tone or Tone()
        frame = samples.frame.numpy()
        rows = np.flatnonzero(np.isin(frame, self.frames))
        was = samples.color.numpy()[rows]
        off = self.log[np.searchsorted(self.frames, frame[rows])].astype(np.float32)
        linear = tone.undone(was / np.float32(255)) * np.exp(-off)
        shown = tone.shown(torch.from_numpy(linear).clamp(max=1)).numpy()
        color = samples.color.clone()
        color[torch.from_numpy(rows)] = torch.from_numpy(
            np.where(was < CLIPPED, np.rint(255 * shown), CLIPPED).astype(np.uint8)
        )
        return replace(samples, color=color)

    def __str__(self) -> str:
        worst, channel = np.unravel_index(np.abs(self.log).argmax(), self.log.shape)
        numbers = ", ".join(map(str, self.frames))
        return (
            f"photo {self.frames[worst]} is {told(self.log[worst, channel], channel)} than the other photos "
            f"of the same places; of another white balance, and fitted as if it were the others': {numbers}"
        )

    def to_dict(self) -> dict[str, Sequence[float]]:
        """``log`` by the photo's number."""
        return {str(frame): row for frame, row in zip(self.frames, self.log.round(4).tolist(), strict=True)}


def standing_out(log: np.ndarray, sure: np.ndarray) -> np.ndarray:
    """Which photos stand out among all, bool [F].

    What a bounce errs by turns the hues of photos, too, more and more along the camera's path. So none does
    that others, which do not, pass into by steps of less than a cast.

    Args:
        log: ln of red and blue, beside green and the median photo, in the order of the path, [F, 2].
        sure: how much of that is sure, [F, 2].
    """
    stands_out = (sure > max(LEAST_CAST, WIDTHS * robust_std(log))).any(axis=1)
    jumps = np.abs(np.diff(log, axis=0)).max(axis=1) > LEAST_CAST
    run = np.append(0, np.cumsum(jumps))
    return np.bincount(run, ~stands_out)[run] == 0


def told(log: float, channel: int) -> str:
    """``6 % less red``, of a channel's ``log`` ratio."""
    change = np.expm1(log)
    return f"{100 * abs(change):.0f} % {'more' if change > 0 else 'less'} {COLORS[channel]}"

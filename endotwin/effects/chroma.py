"""The recorder: colour at half the size of brightness."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np

from endotwin.effects.codec import Codec
from endotwin.effects.effect import Effect
from endotwin.effects.luma import LUMA
from endotwin.sequence import Sequence
from endotwin.sequence.images import unclipped

TO_RED, TO_BLUE = 1.402, 1.772
"""By which Cr and Cb are multiplied to be what red and blue have more than luminance (ITU-R BT.601)."""

YCBCR = np.stack(
    [LUMA, ([0, 0, 1] - LUMA) / np.float32(TO_BLUE), ([1, 0, 0] - LUMA) / np.float32(TO_RED)]
).astype(np.float32)
"""Rows: Y, Cb and Cr of R, G and B."""

PHOTOS = 8
"""Spread over a sequence, whose detail is looked at."""

RUN_PX = 16
"""Length of the runs of pixels whose spectrum is taken."""

MARGIN_PX = 9
"""Off the lens's edge."""

BROAD, FINEST = slice(1, 3), slice(7, 9)
"""Of the nine frequencies of a run: those that half the size keeps, and those that it cannot have."""

ROUNDING = (YCBCR**2).sum(axis=1) / 12
"""Variance that rounding R, G and B to levels leaves in Y, Cb and Cr."""


@dataclass(frozen=True)
class Chroma(Effect):
    """Colour differences Cb and Cr (ITU-R BT.601) as means of 2×2 pixels, between which they are interpolated
    when they are shown (4:2:0). Luminance stays as it is.
    """

    name: ClassVar[str] = "chroma"

    def recorded(self, color: np.ndarray) -> np.ndarray:
        """Display values float32 [H, W, 3] as they are shown."""
        height, width = color.shape[:2]
        even = cv2.copyMakeBorder(color, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE) @ YCBCR.T
        small = cv2.resize(even[..., 1:], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        shown = cv2.resize(small, even.shape[1::-1], interpolation=cv2.INTER_LINEAR)[:height, :width]
        luma = even[:height, :width, 0]
        red, blue = luma + TO_RED * shown[..., 1], luma + TO_BLUE * shown[..., 0]
        green = (luma - LUMA[0] * red - LUMA[2] * blue) / LUMA[1]
        return np.clip(np.stack([red, green, blue], axis=2), 0, 1)

    @classmethod
    def evidence(cls, sequence: Sequence) -> tuple[Chroma | None, str]:
        """Fine detail whose colours are missing: of one hue it has in Cb and Cr, next to that in Y, what
        broad detail has, or more, where noise of each channel or changes of hue add to it. That must be
        beyond what rounding leaves, and less than half of it be there.
        """
        chosen = sequence.spread(PHOTOS)
        lit = sequence.well_lit(MARGIN_PX)
        measured = [_details(sequence.color(index), lit) for index in chosen]
        broad, *finest = np.mean(measured, axis=0)
        share = min(_share_of_colour(broad, each) for each in finest)
        if share > 0.5:
            return None, "rendered on request: the photos' finest detail does not lack colour"
        if Codec.evidence(sequence)[0] is not None:
            return None, "the photos' colour is at half its size, as the codec leaves it"
        told = f"the photos' finest detail has {max(share, 0):.0%} of the colour that broader detail has"
        return cls(), told


def _share_of_colour(broad: np.ndarray, finest: np.ndarray) -> float:
    """Of the power in Cb and Cr that the ``finest`` detail would have of the hues of ``broad`` detail, [3] of
    Y, Cb and Cr; inf where that is no more than rounding's."""
    rounding = ROUNDING[1:].sum()
    wanted = broad[1:].sum() / max(broad[0], ROUNDING[0]) * finest[0]
    return float((finest[1:].sum() - rounding) / wanted) if wanted > rounding else np.inf


def _details(photo: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """Power, levels², of Y, Cb and Cr of a photo uint8 [H, W, 3] where it is ``lit`` [H, W] and not clipped,
    [3, 3]: broad detail; the finest, which colours between which is interpolated lack; and that within 2×2
    pixels, which repeated ones lack. Rounding's is ROUNDING in each.
    """
    usable = lit & unclipped(photo)
    image = photo @ YCBCR.T
    spectra = (_of_runs(image, usable) + _of_runs(image.swapaxes(0, 1), usable.T)) / 2
    broad, finest = (spectra[:, each].mean(axis=1) for each in (BROAD, FINEST))
    return np.stack([broad, finest, _of_pairs(image, usable)])


def _of_pairs(image: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Variance [3] within 2×2 usable pixels of an image [H, W, 3]; 0 without one."""
    down, across = image.shape[0] // 2, image.shape[1] // 2
    blocks = np.stack([image[k : 2 * down : 2, j : 2 * across : 2] for k in (0, 1) for j in (0, 1)])
    whole = np.all([usable[k : 2 * down : 2, j : 2 * across : 2] for k in (0, 1) for j in (0, 1)], axis=0)
    return blocks[:, whole].var(axis=0, ddof=1).mean(axis=0) if whole.any() else np.zeros(3)


def _of_runs(image: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Mean power spectra [3, 9] of the usable runs of an image [H, W, 3] along its rows; 0 without one."""
    window = np.hanning(RUN_PX + 1)[:-1]
    across = image.shape[1] // RUN_PX
    whole = image[:, : across * RUN_PX].reshape(-1, RUN_PX, 3)
    runs = whole[usable[:, : across * RUN_PX].reshape(-1, RUN_PX).all(axis=1)]
    spectra = np.fft.rfft((runs - runs.mean(axis=1, keepdims=True)) * window[:, None], axis=1)
    return (np.abs(spectra) ** 2).sum(axis=0).T / (max(len(runs), 1) * (window @ window))

"""Sensor noise: read noise and shot noise, as strong as in the photos."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from scipy.fft import dctn
from scipy.optimize import nnls
from torch import Tensor

from endotwin.effects.effect import Effect, parameter
from endotwin.sequence import Sequence

LEVEL = 1 / 255
"""One step of an 8-bit image, in display values; rounding to it has the variance LEVEL²/12."""

VISIBLE = 0.5 * LEVEL
"""Noise below this is lost in the rounding."""

FRAMES = 4
BLOCK = 8
FREQUENCY = np.add.outer(np.arange(BLOCK), np.arange(BLOCK))
HIGH = FREQUENCY > BLOCK
LOW = ~HIGH & (FREQUENCY > 0)
"""Cosine coefficients of a block that show noise, and those that show structure."""

FLATTEST = 0.1
"""Share of the blocks of one brightness that its noise is taken from."""

BRIGHTNESSES = 12
BLOCKS_A_BRIGHTNESS = 10

CLEARANCE = 3.0
"""Standard deviations to the ends of the range, which clip the noise of a brightness nearer to them."""


@dataclass(frozen=True)
class Noise(Effect):
    """Gaussian noise, independent in each pixel and channel: var(C) = read² + shot·C (Foi et al. 2008).

    C is the display value in [0, 1], and so is what comes out.

    Attributes:
        read_noise: standard deviation in the dark. shot_noise: growth of the variance with C.
    """

    name: ClassVar[str] = "noise"
    read_noise: float = parameter(LEVEL, 0.0, 0.2)
    shot_noise: float = parameter(0.0, 0.0, 0.05)

    def sigma(self, color: np.ndarray | float) -> np.ndarray:
        """Standard deviation at display values in [0, 1], of the same shape."""
        return np.sqrt(self.read_noise**2 + self.shot_noise * np.maximum(color, 0))

    def read(self, color: np.ndarray | Tensor, generator: np.random.Generator) -> np.ndarray | Tensor:
        """Display values float32 [H, W, 3] as the sensor reads them, in [0, 1]; array in, array out."""
        values = np.asarray(color, np.float32)
        noisy = generator.standard_normal(values.shape, np.float32)
        noisy *= self.sigma(values) if self.shot_noise else np.float32(self.read_noise)
        noisy += values
        noisy.clip(0, 1, out=noisy)
        return torch.from_numpy(noisy) if isinstance(color, Tensor) else noisy

    @classmethod
    def measured(cls, sequence: Sequence, frames: int = FRAMES) -> Noise | None:
        """The noise of ``frames`` photos spread over the sequence; see :meth:`measured_in`."""
        photos = (sequence.color(index) for index in sequence.spread(frames))
        return cls.measured_in(photos, sequence.lens_mask)

    @classmethod
    def measured_in(cls, photos: Iterable[np.ndarray], mask: np.ndarray) -> Noise | None:
        """The noise of photos uint8 [H, W, 3] within a mask [H, W], without that of rounding to 8 bits.

        Blocks of 8×8 pixels are taken, brightness by brightness, whose low cosine frequencies show the least
        structure: their high ones then show noise (Colom & Buades 2013, after Ponomarenko et al. 2007). Noise
        that a camera has smoothed away is not in those frequencies, and not measured. None where too few
        blocks lie within the mask and the range.
        """
        found = [_blocks(photo, mask) for photo in photos]
        brightness, structure, high = (np.concatenate(values) for values in zip(*found, strict=True))
        means, variances = [], []
        for part in np.array_split(np.argsort(brightness), BRIGHTNESSES):
            flattest = part[np.argsort(structure[part])[: round(FLATTEST * len(part))]]
            if len(flattest) < BLOCKS_A_BRIGHTNESS:
                continue
            mean, variance = brightness[flattest].mean(), np.median(high[flattest].mean(axis=0))
            if CLEARANCE * np.sqrt(variance) < min(mean, 1 - mean):
                means.append(mean)
                variances.append(variance)
        if not means:
            return None
        weight = 1 / np.maximum(variances, LEVEL**2 / 12)
        line = np.stack([np.ones(len(means)), means], axis=1)
        own = np.array(variances) - LEVEL**2 / 12
        (read_variance, shot), _ = nnls(line * weight[:, None], own * weight)
        return cls(float(np.sqrt(read_variance)), float(shot))

    @classmethod
    def evidence(cls, sequence: Sequence) -> tuple[Noise | None, str]:
        """Measured noise of at least half a level at mid-range."""
        noise = cls.measured(sequence)
        if noise is None:
            return None, "the photos have too few flat, unclipped blocks to measure noise in"
        levels = float(noise.sigma(0.5)) / LEVEL
        found = f"the photos' noise is {levels:.2f} of 255 levels at mid-range"
        if noise.sigma(0.5) < VISIBLE:
            return None, f"{found}, less than what rounding to 8 bits adds"
        return noise, f"{found} (read {noise.read_noise:.2g}, shot {noise.shot_noise:.2g})"


def _blocks(photo: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Brightness [N], structure [N] and high-frequency powers [N, K] of the blocks of all channels.

    Only blocks within the mask that have no pixel at the ends of the range, in display values.
    """
    down, across = (size // BLOCK for size in mask.shape)

    def tiled(image: np.ndarray) -> np.ndarray:
        whole = image[: down * BLOCK, : across * BLOCK]
        return whole.reshape(down, BLOCK, across, BLOCK, image.shape[2]).transpose(0, 2, 4, 1, 3)

    tiles = tiled(photo)
    within = (tiles.min(axis=(3, 4)) > 0) & (tiles.max(axis=(3, 4)) < 255)
    blocks = tiles[within & tiled(mask[..., None]).all(axis=(3, 4))].astype(np.float32) * np.float32(LEVEL)
    power = dctn(blocks, axes=(1, 2), norm="ortho") ** 2
    return blocks.mean(axis=(1, 2)), power[:, LOW].sum(axis=1), power[:, HIGH]

"""Photos of texture with known effects, as sequences of files."""

from functools import cache
from pathlib import Path

import cv2
import numpy as np

from endotwin.cameras import Pinhole
from endotwin.sequence import Sequence
from endotwin.sequence.images import write_png


def photographed(folder: Path, photos: list[np.ndarray]) -> Sequence:
    """A sequence of these photos, uint8 [H, W, 3], kept as PNG files, without depth."""
    files = tuple(folder / f"{k:04d}.png" for k in range(len(photos)))
    for file, photo in zip(files, photos, strict=True):
        write_png(file, photo, overwrite=True)
    height, width = photos[0].shape[:2]
    camera = Pinhole(width, height, 100.0, 100.0, (width - 1) / 2, (height - 1) / 2)
    poses = np.repeat(np.eye(4)[None], len(files), axis=0)
    return Sequence(folder, "c3vd", camera, poses, files, (), lambda file: None, np.arange(len(files)) / 30)


@cache
def textured(seed: int, height: int = 240, width: int = 320) -> np.ndarray:
    """Smooth reddish texture at four scales, float32 [H, W, 3] in [0, 1]."""
    rng = np.random.default_rng(seed)
    grains = [(size, rng.standard_normal((height, width))) for size in (1.5, 3, 8, 25)]
    shade = sum(size * cv2.GaussianBlur(grain, (0, 0), size) for size, grain in grains)
    shade = 0.5 + 0.12 * shade / shade.std()
    color = np.stack([shade, 0.7 * shade + 0.05, 0.5 * shade], axis=2).astype(np.float32)
    color.setflags(write=False)
    return color


def levels(color: np.ndarray, noise_levels: float = 0.0, seed: int = 0) -> np.ndarray:
    """Display values as a photo uint8, with white noise."""
    noise = noise_levels * np.random.default_rng(seed).standard_normal(color.shape)
    return np.clip(255 * color + noise, 0, 255).round().astype(np.uint8)

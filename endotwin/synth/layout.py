"""C3VD's layout (version 1) of a rendered dataset: how each label is encoded, and the words that say so."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from endotwin.errors import OutputError
from endotwin.readers.c3vd import DEPTH_RANGE_MM

MASK_NONE, MASK_UNSEEN, MASK_VALID = 0, 128, 255

CONVENTIONS = {
    "color": "NNNN_color.png: 8-bit RGB, after the camera response; black where no surface is seen",
    "depth": "NNNN_depth.tiff: 16-bit z-depth, raw / 65535 * 100 mm; 0: none; 65535: 100 mm up (clipped)",
    "normals": "NNNN_normals.tiff: 16-bit RGB, raw / 65535 * 2 - 1 = x, y, z of the unit normal that points "
    "into the lumen, in camera axes; 0, 0, 0: none",
    "mask": "NNNN_mask.png: 255: surface that the training photos show; 128: surface that none of them shows "
    "(its materials are a guess, its shape may be filled in); 0: no surface",
    "poses": "pose.txt: a line a frame, the 4x4 camera-to-world matrix column by column (C3VD's order), mm",
    "camera": "camera.json: camera model and intrinsics in pixels; pixel centres at whole numbers; "
    "camera axes x right, y down, z forward (OpenCV)",
    "timestamps": "timestamps.txt: seconds, a line a frame",
}

# Measured on VGA frames of a fitted twin, one core:
# PNG level 1, run lengths, filter of averages: 8 ms and 216 kB; with all filters tried: 14 ms and 207 kB.
# Depth: Deflate of differences 15 ms, 187 kB; plain Deflate 11 ms, 487 kB; uncompressed 1 ms, 615 kB.
# Normals: Deflate of differences 60 ms, 1.25 MB; plain Deflate 25 ms, 1.72 MB; uncompressed 1 ms, 1.84 MB.
# LZW is no smaller, and tifffile cannot read it without further packages.
PNG = (
    *(cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE),
    *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_AVG),
)
DEPTH_TIFF = (
    *(cv2.IMWRITE_TIFF_COMPRESSION, cv2.IMWRITE_TIFF_COMPRESSION_ADOBE_DEFLATE),
    *(cv2.IMWRITE_TIFF_PREDICTOR, cv2.IMWRITE_TIFF_PREDICTOR_HORIZONTAL),
)
NORMALS_TIFF = (cv2.IMWRITE_TIFF_COMPRESSION, cv2.IMWRITE_TIFF_COMPRESSION_NONE)


@dataclass(frozen=True)
class Labels:
    """One rendered frame, as the dataset keeps it.

    Attributes:
        color: float32 [H, W, 3], display-encoded RGB in [0, 1].
        depth_mm: float32 [H, W], z-depth; NaN where there is none.
        normals: float32 [H, W, 3], unit, camera frame; 0 where there are none.
        mask: uint8 [H, W], one of MASK_NONE, MASK_UNSEEN, MASK_VALID.
    """

    color: np.ndarray
    depth_mm: np.ndarray
    normals: np.ndarray
    mask: np.ndarray


def write_frame(folder: Path, index: int, labels: Labels) -> None:
    """Write the four files of frame ``index``; the same labels give the same bytes. Raises OutputError."""
    stem = f"{index:04d}_"
    color, seen = encode_color(labels.color), labels.mask != MASK_NONE
    normals = encode_normals(labels.normals, seen)
    _write(folder / f"{stem}color.png", cv2.cvtColor(color, cv2.COLOR_RGB2BGR), PNG)
    _write(folder / f"{stem}depth.tiff", encode_depth(labels.depth_mm), DEPTH_TIFF)
    _write(folder / f"{stem}normals.tiff", cv2.cvtColor(normals, cv2.COLOR_RGB2BGR), NORMALS_TIFF)
    _write(folder / f"{stem}mask.png", labels.mask, PNG)


def encode_color(color: np.ndarray) -> np.ndarray:
    """Display values [...] in [0, 1] as uint8, to the nearest."""
    return np.rint(np.clip(color, 0, 1) * np.float32(255)).astype(np.uint8)


def encode_depth(depth_mm: np.ndarray) -> np.ndarray:
    """Z-depth [H, W] as uint16: 0 where there is none, or none in front; 65535 from 100 mm on."""
    raw = np.rint(depth_mm * np.float32(65535 / DEPTH_RANGE_MM))
    return np.clip(np.where(depth_mm > 0, np.maximum(raw, 1), 0), 0, 65535).astype(np.uint16)


def encode_normals(normals: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Unit normals [H, W, 3] as uint16, 0 where not ``seen`` [H, W]."""
    raw = np.rint((np.clip(normals, -1, 1) + 1) * np.float32(65535 / 2))
    return (raw * seen[..., None]).astype(np.uint16)


def _write(path: Path, image: np.ndarray, options: tuple[int, ...]) -> None:
    try:
        written = cv2.imwrite(str(path), image, options)
    except cv2.error as error:
        raise OutputError(f"{path} cannot be written ({error.err}); is the disk full?") from error
    if not written:
        raise OutputError(f"{path} cannot be written; is the disk full?")

"""Photos with depth of one size, from sequences and from datasets, in files that are read page by page."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np

from endotwin.errors import OptionError
from endotwin.run.ahead import ahead
from endotwin.run.output import whole_file
from endotwin.run.threads import THREADS
from endotwin.sequence import Sequence
from endotwin.sequence.sequence import resized_depth
from endotwin.sequence.spread import spread
from endotwin.study.accuracy import FARTHEST_MM
from endotwin.study.corruptions import as_jpeg
from endotwin.synth.containers import pixels
from endotwin.synth.encodings import decode_depth
from endotwin.synth.labels import MASK_UNSEEN

COLOR, DEPTH, ASKED = "color.npy", "depth.npy", "asked.json"

Size = tuple[int, int]
"""Width and height in pixels."""

Frame = tuple[np.ndarray, np.ndarray]
"""A photo uint8 [H, W, 3], and its depth [H, W] in mm, NaN where there is none."""


@dataclass(frozen=True, eq=False)
class Frames:
    """Photos with depth.

    Attributes:
        color: uint8 [N, H, W, 3], RGB as displayed. depth_mm: float16 [N, H, W], NaN where there is none.
        chosen: int [M], the frames that count.
    """

    color: np.ndarray
    depth_mm: np.ndarray
    chosen: np.ndarray

    def __len__(self) -> int:
        return len(self.chosen)

    def __getitem__(self, index: int) -> Frame:
        """One frame, its depth as float32."""
        number = self.chosen[index]
        return self.color[number], self.depth_mm[number].astype(np.float32)

    def some(self, count: int) -> Frames:
        """``count`` of them, evenly spread; all where there are no more."""
        return replace(self, chosen=self.chosen[spread(len(self), count)])


def of_sequence(sequence: Sequence, size: Size) -> Iterator[Frame]:
    """Photo and depth of each frame at ``size``; no depth where the lens lets no light through."""
    lit = lit_pixels(sequence, size)

    def read(index: int) -> Frame:
        color, depth_mm = sequence.color(index), sequence.depth_mm(index)
        return shrunk(color, size), np.where(lit, resized_depth(depth_mm, *size), np.nan)

    return ahead(read, range(len(sequence)), THREADS)


def require_depth(sequence: Sequence, size: Size) -> None:
    """Raise OptionError unless some frame at ``size`` has depth to learn from or be judged by."""
    if not any((depth_mm <= FARTHEST_MM).any() for _, depth_mm in of_sequence(sequence, size)):
        raise OptionError(
            f"{sequence.path} has no depth within {FARTHEST_MM:g} mm where its photos are lit; leave it out"
        )


def lit_pixels(sequence: Sequence, size: Size) -> np.ndarray:
    """Bool [H, W] at ``size``: not the black around the lens circle of a sequence's photos."""
    lit = sequence.lens_mask.astype(np.float32)
    return cv2.resize(lit, size, interpolation=cv2.INTER_AREA) > 0.5


def of_dataset(
    folder: Path, size: Size, lit: np.ndarray, codec: tuple[int, int] | None = None, seed: int = 0
) -> Iterator[Frame]:
    """Photo and depth of each frame of a dataset in the layout ``webdataset``, with rgb, depth and mask.

    Filled-in surface has no depth, since its shape is a guess.

    Args:
        lit: bool [H, W] at ``size``; the rest becomes black, and has no depth.
        codec: least and greatest quality of a JPEG that each photo has been, drawn by ``seed``.
    """
    import webdataset

    shards = sorted(str(file) for file in folder.glob("shard-*.tar"))
    for index, frame in enumerate(webdataset.WebDataset(shards, shardshuffle=False)):
        color = pixels(frame["rgb.png"])
        if codec:
            quality = np.random.default_rng((seed, index)).integers(codec[0], codec[1] + 1)
            color = as_jpeg(color, int(quality))
        depth_mm = decode_depth(frame["depth.tiff"])
        known = np.isfinite(depth_mm) & (pixels(frame["mask.png"]) >= MASK_UNSEEN)
        depth_mm = np.where(known, depth_mm, np.nan).astype(np.float32)
        yield shrunk(color, size) * lit[..., None], np.where(lit, resized_depth(depth_mm, *size), np.nan)


def shrunk(color: np.ndarray, size: Size) -> np.ndarray:
    """A photo uint8 [h, w, 3] at ``size``, each pixel the mean of what it covers."""
    return cv2.resize(np.ascontiguousarray(color), size, interpolation=cv2.INTER_AREA)


def kept(frames: Iterator[Frame], count: int, size: Size, folder: Path, asked: dict) -> Frames:
    """``count`` frames in the files of ``folder``, written unless those that were ``asked`` lie there."""
    if not ((folder / ASKED).exists() and json.loads((folder / ASKED).read_text("utf-8")) == asked):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        shape = (count, size[1], size[0])
        with (folder / COLOR).open("wb") as colors, (folder / DEPTH).open("wb") as depths:
            _begin(colors, np.uint8, (*shape, 3))
            _begin(depths, np.float16, shape)
            for color, depth_mm in frames:
                colors.write(color.astype(np.uint8).tobytes())
                depths.write(depth_mm.astype(np.float16).tobytes())
        with whole_file(folder / ASKED) as file:
            file.write_text(json.dumps(asked), encoding="utf-8")
    color, depth_mm = (np.load(folder / name, mmap_mode="r") for name in (COLOR, DEPTH))
    if not (depth_mm <= FARTHEST_MM).any():
        raise OptionError(f"{asked['source']} has no depth within {FARTHEST_MM:g} mm; leave it out")
    return Frames(color, depth_mm, np.arange(count))


def _begin(file: BinaryIO, kind: type, shape: tuple[int, ...]) -> None:
    """The header of a NumPy file: what follows is written frame by frame, so that a full disk is an error."""
    header = {"descr": np.lib.format.dtype_to_descr(np.dtype(kind)), "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, header)

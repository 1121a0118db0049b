"""A posed RGB-D sequence on disk, whatever its layout: the noun that everything starts from."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from endotwin.cameras.base import Camera
from endotwin.errors import SequenceError
from endotwin.sequence.images import orientation, read_color, written_size
from endotwin.sequence.spread import spread

SURROUND_FRAMES = 8
SURROUND_LEVEL = 3  # of 255, the brightest that noise makes a black pixel
SURROUND_AREA = 0.002  # of the image, the least that counts as a surround
ISLAND_AREA = 0.01
RINGING_SHARE = 0.25  # of the lit image's median: what a codec's ringing may reach beside the lens circle
RINGING_PX = 23  # how far it reaches: across a block of 16 × 16, whose chroma is stored at half size
HALO_PX = 3  # within the circle, where sharpening and chroma at half size mix its edge with the black
DEPTH_SPREAD = 0.02

logger = logging.getLogger("endotwin")


@dataclass(frozen=True, eq=False)
class Frame:
    """One photo with its depth and pose, in memory.

    Attributes:
        index: position in the sequence.
        name: the frame's name in its folder, for messages.
        color: uint8 [H, W, 3], RGB as photographed (display-encoded).
        depth_mm: float32 [H, W], z-depth; NaN where there is none.
        T_world_camera: float64 [4, 4], camera to world.
    """

    index: int
    name: str
    color: np.ndarray
    depth_mm: np.ndarray
    T_world_camera: np.ndarray


@dataclass(frozen=True)
class Split:
    """The frames of a sequence, by index, that its own files say are to be fitted, and to be scored by."""

    training: tuple[int, ...]
    heldout: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Sequence:
    """A posed RGB-D sequence; frames are read when asked for and never kept.

    Made by :func:`endotwin.open_sequence`. Files are listed and poses checked when it is opened.

    Attributes:
        path: the folder (or the ``transforms.json``) that it was opened from.
        format: name of the reader, for example ``c3vd``.
        camera: camera model of the frames as they are returned (``scale`` applied).
        T_world_camera: float64 [N, 4, 4], camera to world, millimetres.
        color_files, depth_files: one path a frame.
        read_depth_mm: reads one depth file at its native size: float32 [h, w], NaN where invalid.
        timestamps_s: float64 [N].
        scale: factor on the image size, 1 = native.
        image_size: (width, height) of the files; the camera's own unless given.
        split: the frames that are used; None where the files say nothing of one: all are.
        camera_file: name of the file that the camera is to be written to.
    """

    path: Path
    format: str
    camera: Camera
    T_world_camera: np.ndarray
    color_files: tuple[Path, ...]
    depth_files: tuple[Path, ...]
    read_depth_mm: Callable[[Path], np.ndarray]
    timestamps_s: np.ndarray
    scale: float = 1.0
    image_size: tuple[int, int] = (0, 0)
    split: Split | None = None
    camera_file: str = "camera.json"

    def __post_init__(self) -> None:
        if self.image_size == (0, 0):
            object.__setattr__(self, "image_size", (self.camera.width, self.camera.height))

    def __len__(self) -> int:
        return len(self.color_files)

    def __repr__(self) -> str:
        size = f"{self.camera.width}×{self.camera.height} {self.camera.model}"
        return f"Sequence({self.path}: {len(self)} frames, {size}, {self.format})"

    def check(self) -> None:
        """Raise SequenceError unless there are frames, as many poses, and a first photo of its size."""
        if not len(self):
            raise SequenceError(f"{self.path} has no frames; name the folder that holds the photos")
        if len(self.T_world_camera) != len(self):
            raise SequenceError(
                f"{self.path} has {len(self)} frames but {len(self.T_world_camera)} poses; "
                "add or remove poses until there is one a frame"
            )
        self._native_color(0)
        if (turned := orientation(self.color_files[0])) != 1:
            logger.warning(
                "%s is marked as turned (EXIF orientation %d), which is not heeded: camera, pose and depth "
                "belong to the pixels as they are stored",
                *(self.color_files[0], turned),
            )

    def color(self, index: int) -> np.ndarray:
        """Photo ``index``, uint8 [H, W, 3], RGB."""
        return self._resized_color(self._native_color(index))

    def depth_mm(self, index: int) -> np.ndarray:
        """Depth map ``index``, float32 [H, W], z-depth in mm, NaN where there is none.

        At a scale other than 1, depth is averaged within a surface and never across a jump between two.
        """
        depth_mm = self.read_depth_mm(self.depth_files[index])
        if depth_mm.shape[::-1] != self.image_size:
            raise SequenceError(
                f"{self.depth_files[index]} is {_size(depth_mm)}, but {self.color_files[index].name} is "
                f"{self.image_size[0]}×{self.image_size[1]}; give depth and photo the same size"
            )
        return depth_mm if self.scale == 1 else resized_depth(depth_mm, self.camera.width, self.camera.height)

    def require_valid_depth(self) -> None:
        """Raise SequenceError unless some frame has a valid depth; reads depth maps until it finds one."""
        if not any(np.isfinite(self.read_depth_mm(file)).any() for file in self.depth_files):
            raise SequenceError(f"{self.path} has no valid depth in any frame; check its depth maps")

    def frame(self, index: int) -> Frame:
        """Frame ``index`` with photo, depth and pose; raises SequenceError if they do not fit together."""
        return Frame(
            index=index,
            name=self.color_files[index].name,
            color=self.color(index),
            depth_mm=self.depth_mm(index),
            T_world_camera=self.T_world_camera[index],
        )

    def spread(self, most: int) -> np.ndarray:
        """Indices of at most ``most`` of the frames that are used, evenly spread, int [N]."""
        if self.split is None:
            return spread(len(self), most)
        used = [index for index in sorted({*self.split.training, *self.split.heldout}) if index < len(self)]
        return np.array(used)[spread(len(used), most)]

    @cached_property
    def lens_mask(self) -> np.ndarray:
        """Bool [H, W]: pixels that the lens illuminates, false in an endoscope image's black surround.

        Raises SequenceError if the photos looked at are all black.
        """
        brightest = np.zeros((*self.image_size[::-1], 3), np.uint8)
        for index in self.spread(SURROUND_FRAMES):
            np.maximum(brightest, self._native_color(index), out=brightest)
        brightest = brightest.max(axis=2)
        if brightest.max() <= SURROUND_LEVEL:
            raise SequenceError(f"{self.path} has only black photos; check that they show the lumen")
        lit = (~dark_surround(brightest)).astype(np.float32)
        if self.scale != 1:
            lit = cv2.resize(lit, (self.camera.width, self.camera.height), interpolation=self._interpolation)
        return (lit > 0.999) & np.isfinite(self.camera.pixel_directions).all(axis=2)

    def well_lit(self, margin_px: int) -> np.ndarray:
        """Bool [H, W]: pixels within the ``lens_mask``, farther than ``margin_px`` from its edge."""
        lit = np.pad(self.lens_mask.astype(np.uint8), 1)
        return cv2.erode(lit, np.ones((2 * margin_px + 1,) * 2))[1:-1, 1:-1] > 0

    @property
    def _interpolation(self) -> int:
        return cv2.INTER_AREA if self.scale < 1 else cv2.INTER_LINEAR

    def _native_color(self, index: int) -> np.ndarray:
        color = read_color(self.color_files[index])
        self._require_size(index, color.shape[1::-1])
        return color

    def check_sizes(self, frames: Iterable[int]) -> None:
        """Raise SequenceError for the first of ``frames`` whose photo is of another size, truncated, or no
        image: by its header and its end, unless these leave it open."""
        for index in frames:
            if (size := written_size(self.color_files[index])) is None:
                self._native_color(index)  # says what is wrong
            else:
                self._require_size(index, size)

    def _require_size(self, index: int, size: tuple[int, int]) -> None:
        if size != self.image_size:
            expected = f"{self.image_size[0]}×{self.image_size[1]}"
            fault = (
                f"the camera is {expected}; write size and intrinsics of these images to {self.camera_file}"
            )
            if index > 0:
                fault = f"the photos before it are {expected}; give it that size, or remove the frame"
            raise SequenceError(f"{self.color_files[index]} is {size[0]}×{size[1]}, but {fault}")

    def _resized_color(self, color: np.ndarray) -> np.ndarray:
        if self.scale == 1:
            return color
        return cv2.resize(color, (self.camera.width, self.camera.height), interpolation=self._interpolation)


def dark_surround(brightest: np.ndarray) -> np.ndarray:
    """Bool [H, W]: the black around a lens circle, from the brightest value uint8 [H, W] of each pixel.

    Only large dark regions joined to the image's border count: the dark far end of a lumen is kept. Small
    bright islands within the surround (hot pixels, text) belong to it, and so does the ringing of a lossy
    codec between it and the circle.
    """
    dark = (brightest <= SURROUND_LEVEL).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(dark, connectivity=4)
    border = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    large = [
        label for label in border if label and stats[label, cv2.CC_STAT_AREA] >= SURROUND_AREA * dark.size
    ]
    if not large:
        return np.zeros(dark.shape, bool)
    surround = _with_ringing(np.isin(labels, large), brightest)
    _, labels, stats, _ = cv2.connectedComponentsWithStats((~surround).astype(np.uint8), connectivity=4)
    islands = stats[:, cv2.CC_STAT_AREA] < ISLAND_AREA * dark.size
    return surround | islands[labels]


def _with_ringing(surround: np.ndarray, brightest: np.ndarray) -> np.ndarray:
    """``surround`` bool [H, W] grown over what is dim beside the image's lit part, within RINGING_PX, and if
    there is any, over the HALO_PX at that part's edge."""
    dim = brightest <= max(SURROUND_LEVEL, RINGING_SHARE * np.median(brightest[~surround]))
    distance_px = cv2.distanceTransform((~surround).astype(np.uint8), cv2.DIST_L2, 5)
    near = surround | (dim & (distance_px <= RINGING_PX))
    _, labels = cv2.connectedComponents(near.astype(np.uint8), connectivity=4)
    grown = np.isin(labels, np.unique(labels[surround]))
    if (grown == surround).all():
        return surround
    return cv2.distanceTransform((~grown).astype(np.uint8), cv2.DIST_L2, 5) <= HALO_PX


def resized_depth(depth_mm: np.ndarray, width: int, height: int) -> np.ndarray:
    """Depth [h, w] on another pixel grid: the mean where source pixels agree, else the nearest one's value.

    Pixels agree when all are valid and of ``one_surface``. Depths either side of a fold's rim are thus never
    blended into a depth where there is nothing.
    """
    native_height, native_width = depth_mm.shape
    rows = _nearest(native_height, height)
    columns = _nearest(native_width, width)
    nearest = depth_mm[np.ix_(rows, columns)]
    # A new pixel reaches over |p − centre| < ratio/2 + ½, and its nearest pixel is within ½ of the centre.
    reach = [int(np.ceil(ratio / 2 + 1)) - 1 for ratio in (native_height / height, native_width / width)]
    kernel = np.ones([2 * radius + 1 for radius in reach], np.uint8)
    valid = np.isfinite(depth_mm)
    least = cv2.erode(np.where(valid, depth_mm, -np.inf).astype(np.float32), kernel)[np.ix_(rows, columns)]
    most = cv2.dilate(np.where(valid, depth_mm, np.inf).astype(np.float32), kernel)[np.ix_(rows, columns)]
    shrinks = height < native_height
    mean = cv2.resize(
        np.where(valid, depth_mm, 0).astype(np.float32),
        (width, height),
        interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR,
    )
    return np.where(one_surface(least, most), mean, nearest).astype(np.float32)


def one_surface(least: np.ndarray, most: np.ndarray) -> np.ndarray:
    """Whether neighbouring pixels with depths (or distances) from ``least`` to ``most`` may be blended, bool
    of their shape: not where they lie either side of a fold's rim, nor where one has none (NaN or inf)."""
    return most - least <= DEPTH_SPREAD * least


def _nearest(native: int, new: int) -> np.ndarray:
    """Index of the native pixel whose centre is nearest to each new pixel's centre, int [new]."""
    centres = (np.arange(new) + 0.5) * native / new - 0.5
    return np.clip(np.rint(centres).astype(int), 0, native - 1)


def _size(image: np.ndarray) -> str:
    return f"{image.shape[1]}×{image.shape[0]}"

"""Rays of a picture in packets of sixteen neighbours."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from ctypes import c_float, c_uint, c_void_p
from itertools import repeat
from typing import Self

import numpy as np
from embreex import rtcore, rtcore_scene

from endotwin.surface import embree

SIDE, WIDTH = 4, 16
"""A packet holds a square of pixels."""

BAND = 640
"""Packets, or one row of them if that is more, that are filled and followed at once: they stay in the
cache."""

ROWS = 21
ORIGIN, NEAR, DIRECTION, FAR = slice(0, 3), 3, slice(4, 7), 8
MASK, U, V, TRIANGLE = 9, 15, 16, 17
"""Of Embree 4's RTCRayHit16: 12 rows of the ray and 9 of the hit, WIDTH numbers each (of 8 where Embree was
built without arrays of instances; then the last stays unused)."""

ALIGNED = 64
NONE = 0xFFFFFFFF
COHERENT, FEATURES = 1 << 16, 0xFFFFFFFF


class _Arguments(ctypes.Structure):
    """RTCIntersectArguments and RTCOccludedArguments."""

    _fields_ = (
        ("flags", c_uint),
        ("features", c_uint),
        ("context", c_void_p),
        ("filter", c_void_p),
        ("function", c_void_p),
        ("width", c_float),
    )


class Packets:
    """Follows the rays of pictures into one scene, one picture at a time.

    Attributes:
        native: whether the processor follows a packet at once. Embree then takes two thirds of the time of
            single rays; else it takes the rays of a packet one by one, and somewhat longer.
    """

    def __init__(self, library: ctypes.CDLL, handle: int):
        self._library, self._handle = library, handle
        self.native = embree.takes_sixteen(handle)
        self._arguments = _Arguments(COHERENT, FEATURES, None, None, None, 0)

    @classmethod
    def of(cls, scene: rtcore_scene.EmbreeScene, device: rtcore.EmbreeDevice) -> Self | None:
        """Those of a ``scene`` on its ``device``; None where there is no handle of it."""
        handle = embree.handle(scene, device)
        scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))  # which builds its tree
        return None if handle is None else cls(embree.loaded(), handle)

    def first_hits(
        self, origin: np.ndarray, directions: np.ndarray, valid: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Triangle int32 [H, W] (-1: none), its u and v, and distance, float32 [H, W], of the first hits of
        rays from ``origin`` float32 [3] in ``directions`` [H, W, 3], where they are ``valid`` [H, W]."""
        height, width = valid.shape
        triangle = np.empty((height, width), np.int32)
        u, v, distance_mm = (np.empty((height, width), np.float32) for _ in range(3))
        for rows, packets, mask in self._bands(origin, directions, valid):
            packets[:, FAR] = np.inf
            packets.view(np.uint32)[:, TRIANGLE:] = NONE
            self._follow(self._library.rtcIntersect16, packets, mask)
            codes = packets.view(np.int32)
            for image, row in (
                (triangle, codes[:, TRIANGLE]),
                (u, packets[:, U]),
                (v, packets[:, V]),
                (distance_mm, packets[:, FAR]),
            ):
                image[rows] = _spread(row, width)[: rows.stop - rows.start, :width]
        return triangle, u, v, distance_mm

    def clear(
        self,
        origin: np.ndarray,
        directions: np.ndarray,
        near_mm: np.ndarray,
        far_mm: float,
        valid: np.ndarray,
    ) -> np.ndarray:
        """Bool [H, W]: rays as of ``first_hits`` that meet nothing between ``near_mm`` [H, W] and ``far_mm``
        from the origin; false where they are not ``valid``."""
        height, width = valid.shape
        clear = np.empty((height, width), bool)
        for rows, packets, mask in self._bands(origin, directions, valid):
            packets[:, NEAR] = _packed(near_mm[rows, :, None])[:, 0]
            packets[:, FAR] = far_mm
            self._follow(self._library.rtcOccluded16, packets, mask)
            free = (packets[:, FAR] >= 0) & (mask < 0)
            clear[rows] = _spread(free, width)[: rows.stop - rows.start, :width]
        return clear

    def _bands(
        self, origin: np.ndarray, directions: np.ndarray, valid: np.ndarray
    ) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
        """Rows of the picture, packets float32 [P, ROWS, WIDTH] with their rays, and masks int32 [P,
        WIDTH]."""
        height, width = valid.shape
        across = -(-width // SIDE)
        down = max(BAND // across, 1)
        packets = _aligned((down * across, ROWS, WIDTH), np.float32)
        mask = _aligned((down * across, WIDTH), np.int32)
        packets[:] = 0
        packets[:, ORIGIN] = origin[:, None]
        packets.view(np.uint32)[:, MASK] = NONE
        for start in range(0, height, down * SIDE):
            rows = slice(start, min(start + down * SIDE, height))
            chosen = _packed(valid[rows, :, None])[:, 0]
            here, among = packets[: len(chosen)], mask[: len(chosen)]
            among[:] = -chosen.astype(np.int32)
            here[:, DIRECTION] = _packed(directions[rows])
            yield rows, here, among

    def _follow(self, query, packets: np.ndarray, mask: np.ndarray) -> None:
        arguments = ctypes.addressof(self._arguments)
        masks = range(mask.ctypes.data, mask.ctypes.data + mask.nbytes, mask.strides[0])
        first, step = packets.ctypes.data, packets.strides[0]
        rays = range(first, first + packets.nbytes, step)
        any(map(query, masks, repeat(self._handle), rays, repeat(arguments)))  # None of each: a loop in C


def _packed(image: np.ndarray) -> np.ndarray:
    """Squares [P, C, WIDTH] of an image [H, W, C], which is filled up by its last rows and columns."""
    height, width, channels = image.shape
    if height % SIDE or width % SIDE:
        image = np.pad(image, ((0, -height % SIDE), (0, -width % SIDE), (0, 0)), mode="edge")
    squares = image.reshape(-(-height // SIDE), SIDE, -(-width // SIDE), SIDE, channels)
    return squares.transpose(0, 2, 4, 1, 3).reshape(-1, channels, WIDTH)


def _spread(squares: np.ndarray, width: int) -> np.ndarray:
    """The image [H, W] of squares [P, WIDTH]; it may be wider and higher by less than SIDE."""
    across = -(-width // SIDE)
    image = squares.reshape(-1, across, SIDE, SIDE).transpose(0, 2, 1, 3)
    return image.reshape(-1, across * SIDE)


def _aligned(shape: tuple[int, ...], dtype: type) -> np.ndarray:
    """An array that begins where Embree wants packets to begin."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    memory = np.empty(size + ALIGNED, np.uint8)
    start = -memory.ctypes.data % ALIGNED
    return memory[start : start + size].view(dtype).reshape(shape)

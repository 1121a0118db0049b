"""A sequence as a pinhole camera would have taken it, as published comparisons resample C3VD's.

endotwin itself casts rays through the native camera, which loses nothing; this is for comparison alone.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property

import cv2
import numpy as np

from endotwin.cameras import Pinhole
from endotwin.errors import OptionError
from endotwin.sequence.sequence import Sequence


@dataclass(frozen=True, eq=False, repr=False)
class Undistorted(Sequence):
    """Frames of ``native`` resampled through ``pinhole``, which has the same centre and axes.

    ``camera`` is that pinhole too, until an alignment corrects it: the frames stay as they were resampled.
    """

    native: Sequence | None = None
    pinhole: Pinhole | None = None

    @classmethod
    def of(cls, sequence: Sequence, width: int, height: int) -> Undistorted:
        """``sequence`` through a pinhole of that size, whose principal point is the image's centre. In the
        middle its pixels span what the native ones do, once the native image is made as wide."""
        scale = width / sequence.camera.width
        if not 0 < scale <= 1 or height < 2:
            raise OptionError(
                f"{width}×{height} is no size to undistort photos {sequence.camera.width} wide to; choose "
                "one that is not wider, such as 640x480"
            )
        camera = sequence.camera.scaled(scale)
        middle = (np.array([camera.width, camera.height]) - 1) / 2
        across = camera.directions(middle + np.array([[-0.5, 0], [0.5, 0]]))
        focal = float(1 / np.linalg.norm(across[1] - across[0]))
        pinhole = Pinhole(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
        kept = {field.name: getattr(sequence, field.name) for field in fields(sequence)}
        native = replace(sequence, camera=camera, scale=scale)
        return cls(**{**kept, "camera": pinhole}, native=native, pinhole=pinhole)

    def color(self, index: int) -> np.ndarray:
        """Photo ``index``, uint8 [H, W, 3], RGB; black where the native image ends."""
        return cv2.remap(self.native.color(index), *self._at, cv2.INTER_LINEAR)

    def depth_mm(self, index: int) -> np.ndarray:
        """Depth map ``index``, float32 [H, W], mm, of the nearest native pixel; NaN where there is none."""
        return cv2.remap(self.native.depth_mm(index), *self._at, cv2.INTER_NEAREST, borderValue=np.nan)

    @cached_property
    def lens_mask(self) -> np.ndarray:
        """Bool [H, W]: pixels that the lens illuminates."""
        return cv2.remap(self.native.lens_mask.astype(np.float32), *self._at, cv2.INTER_LINEAR) > 0.999

    @cached_property
    def _at(self) -> tuple[np.ndarray, np.ndarray]:
        """Native columns and rows, float32 [H, W] each, that the pixels see."""
        rays = self.pinhole.pixel_directions.astype(np.float64)
        uv = self.native.camera.project(rays.reshape(-1, 3)).reshape(rays.shape[0], rays.shape[1], 2)
        u, v = np.nan_to_num(uv, nan=-9).astype(np.float32).transpose(2, 0, 1)
        return np.ascontiguousarray(u), np.ascontiguousarray(v)

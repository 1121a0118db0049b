"""A point of the wall, as options tell it: where it lies, or the pixel of a frame that shows it."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import nan

import numpy as np

from endotwin.errors import EndotwinError
from endotwin.surface.casting import Caster, surface_points
from endotwin.twin import Twin


@dataclass(frozen=True)
class WallPoint:
    """Options that tell a point of the wall."""

    x: float = field(default=nan, metadata={"help": "the point, world mm", "signed": True})
    y: float = field(default=nan, metadata={"help": "the point, world mm", "signed": True})
    z: float = field(default=nan, metadata={"help": "the point, world mm", "signed": True})
    frame: int = field(default=-1, metadata={"help": "or the point at pixel u, v of this frame; else of 0"})
    u: float = field(default=nan, metadata={"help": "pixel, to the right"})
    v: float = field(default=nan, metadata={"help": "pixel, down"})

    @property
    def placed(self) -> bool:
        """Whether any part of a place is given."""
        return self.frame >= 0 or not np.isnan([self.x, self.y, self.z, self.u, self.v]).all()


def wall_point(options: WallPoint, twin: Twin, what: str, error: type[EndotwinError]) -> np.ndarray:
    """The point of the options of ``what``, float64 [3], world mm.

    Raises:
        error: none is given, or there is none at that pixel. SequenceError: the sequence is gone.
    """
    given, pixel = np.array([options.x, options.y, options.z]), np.array([options.u, options.v])
    if not np.isnan(given).all() and (options.frame >= 0 or not np.isnan(pixel).all()):
        raise error(f"{what} has two points: give x, y and z, or frame, u and v")
    if not np.isnan(given).any():
        return given
    if np.isnan(pixel).any():
        raise error(f"{what} needs its point: give x, y and z, or frame, u and v")
    poses, camera = twin.sequence().T_world_camera, twin.camera
    frame = max(options.frame, 0)
    if frame >= len(poses):
        raise error(f"{what}: there is no frame {frame}; the sequence has {len(poses)}")
    mask = np.zeros((camera.height, camera.width), bool)
    column, row = round(options.u), round(options.v)
    if column >= camera.width or row >= camera.height:
        raise error(
            f"{what}: pixel {column}, {row} is outside of {camera.width}×{camera.height}; choose another"
        )
    mask[row, column] = True
    hits = Caster(twin.surface, threads=1).cast(camera, poses[frame], mask)
    if not len(hits):
        raise error(f"{what}: pixel {column}, {row} of frame {frame} sees no surface; choose another")
    return surface_points(twin.surface, hits)[0]

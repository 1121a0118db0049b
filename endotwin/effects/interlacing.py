"""Interlacing: a frame's odd rows are half a frame younger than its even ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

from torch import Tensor

from endotwin.effects.effect import Effect
from endotwin.effects.exposure import Shot
from endotwin.sequence import Sequence

FIELDS = (-0.25, 0.25)
"""When the even and the odd rows are exposed, in frame intervals from the labelled pose."""


@dataclass(frozen=True)
class Interlacing(Effect):
    """Two fields a frame, of every other row each (ITU-R BT.601, top field first), woven together: what moves
    has combed edges. Each field passes the lens as a whole picture of its own. Depth, normals and poses are
    those of the labelled pose, which lies between the fields.
    """

    name: ClassVar[str] = "interlacing"

    def woven(self, seen: Callable[[Shot], Tensor], shot: Shot) -> Tensor:
        """Radiance float32 [H, W, 3] of a shot whose pictures are as ``seen``."""
        even, odd = (seen(shifted(shot, time)) for time in FIELDS)
        even = even.clone()
        even[1::2] = odd[1::2]
        return even

    @classmethod
    def evidence(cls, sequence: Sequence) -> tuple[Interlacing | None, str]:
        """Never by itself: photos that were told apart from their videos are no longer interlaced."""
        return None, "rendered on request: interlaced photos have no one pose that a twin could be fitted to"


def shifted(shot: Shot, time: float) -> Shot:
    """The shot whose labelled pose is that of ``time``, with the same velocity."""
    return replace(shot, T_world_camera=shot.pose(time), T_world_next=shot.pose(time + 1))

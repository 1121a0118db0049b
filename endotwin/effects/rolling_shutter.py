"""Rolling shutter: rows are read one after the other while the camera moves."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from endotwin.effects.effect import parameter
from endotwin.effects.exposure import ExposureEffect, Shot
from endotwin.sequence import Sequence


@dataclass(frozen=True)
class RollingShutter(ExposureEffect):
    """Row r of H sees the scene from T(t_r), t_r = readout·((r + ½)/H − ½) in frame intervals.

    The top row is read first and the middle row at the labelled pose (the uniform model of Meingast, Geyer &
    Sastry 2005). Depth, normals and poses stay those of the labelled pose.

    Attributes:
        readout: time from the first row to the last, in frame intervals.
    """

    name: ClassVar[str] = "rolling_shutter"
    readout: float = parameter(0.8, 0.0, 1.0)

    def timed(self, shot: Shot) -> Shot:
        return replace(shot, readout=self.readout)

    @classmethod
    def evidence(cls, sequence: Sequence) -> tuple[RollingShutter | None, str]:
        """Never by itself: a pose a frame was estimated from all rows, and took up the shear's mean."""
        return None, "rendered on request: one pose a frame has no trace of the time between its rows"

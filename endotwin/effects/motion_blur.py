"""Motion blur: the camera moves while the shutter is open."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from endotwin.effects.effect import parameter
from endotwin.effects.exposure import ExposureEffect, Shot
from endotwin.sequence import Sequence


@dataclass(frozen=True)
class MotionBlur(ExposureEffect):
    """Each pixel is the mean of the radiance along the camera's own way while the shutter is open.

    C(u) = 1/s ∫ L(u, T(t)) dt over −s/2 … s/2, s the shutter in frame intervals; T(t) is the screw through
    the pose and the next one (Potmesil & Chakravarty 1983, with the trajectory for a motion model). The mean
    is taken of linear radiance, before the response.

    Attributes:
        shutter: time that the shutter is open, in frame intervals (½ is film's 180° shutter).
    """

    name: ClassVar[str] = "motion_blur"
    shutter: float = parameter(0.5, 0.0, 1.0)

    def timed(self, shot: Shot) -> Shot:
        return replace(shot, shutter=self.shutter)

    @classmethod
    def evidence(cls, sequence: Sequence) -> tuple[MotionBlur | None, str]:
        """Never by itself: a blurred photo of sharp tissue and a sharp one of soft tissue look alike."""
        return None, "rendered on request: photos alone do not tell blur from smooth tissue"

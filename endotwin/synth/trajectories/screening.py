"""The gate that every pose passes before it is rendered."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isfinite

import numpy as np
from scipy.spatial import cKDTree

from endotwin.cameras import Camera
from endotwin.errors import OptionError, SequenceError
from endotwin.synth.trajectories.lumen import Lumen, Outlook
from endotwin.twin import Twin


@dataclass(frozen=True)
class Limits:
    """What a pose must keep, besides lying inside the surface and looking at it.

    Attributes:
        clearance_mm: least distance of the camera centre from the wall.
        unknown: greatest share of the view that shows unseen or filled-in surface, or none.
        training_mm: greatest distance from the nearest training view.
    """

    clearance_mm: float = 1.0
    unknown: float = 0.5
    training_mm: float = inf

    def __post_init__(self) -> None:
        if not (self.clearance_mm >= 0 and isfinite(self.clearance_mm)):
            raise OptionError(f"the clearance is {self.clearance_mm:g} mm, but must be 0 or more")
        if not 0 <= self.unknown <= 1:
            raise OptionError(f"the share of unseen surface is {self.unknown:g}, but must be from 0 to 1")
        if not self.training_mm > 0:
            raise OptionError(
                f"the distance from training views is {self.training_mm:g}, but must be above 0"
            )


@dataclass(frozen=True)
class Findings:
    """What the gate found of N poses.

    Attributes:
        outlook: what they see. training_mm: float64 [N], distance to the nearest training view, NaN where
            the sequence is gone. passes: bool [N].
    """

    outlook: Outlook
    training_mm: np.ndarray
    passes: np.ndarray

    def checks(self, chosen: np.ndarray) -> dict[str, np.ndarray]:
        """The numbers of the chosen poses, by name."""
        found = {
            "clearance_mm": self.outlook.clearance_mm,
            "unseen": self.outlook.unseen,
            "filled": self.outlook.filled,
            "empty": self.outlook.empty,
            "training_mm": self.training_mm,
        }
        return {name: values[chosen] for name, values in found.items() if np.isfinite(values).all()}


class Gate:
    """Judges poses of one twin through one camera."""

    def __init__(self, twin: Twin, camera: Camera, limits: Limits):
        self.lumen, self.camera, self.limits = Lumen(twin.surface), camera, limits
        self._training = _training_views(twin, required=isfinite(limits.training_mm))

    def judge(self, T_world_camera: np.ndarray) -> Findings:
        """What the poses [N, 4, 4] see, and which of them may be rendered."""
        poses = np.asarray(T_world_camera, np.float64)
        outlook = self.lumen.outlook(self.camera, poses)
        training_mm = np.full(len(poses), np.nan)
        if self._training is not None:
            training_mm = self._training.query(poses[:, :3, 3])[0]
        passes = outlook.inside & (outlook.clearance_mm >= self.limits.clearance_mm)
        passes &= _unknown(outlook) <= self.limits.unknown
        passes &= ~(training_mm > self.limits.training_mm)
        return Findings(outlook, training_mm, passes)

    def fault(self, findings: Findings, index: int) -> str:
        """What is wrong with a pose that does not pass, as the end of a sentence."""
        outlook, limits = findings.outlook, self.limits
        if not outlook.inside[index]:
            return (
                f"lies outside the surface or looks away from it: {outlook.front[index]:.0%} of its view "
                f"meets "
                f"the lumen's wall, {outlook.back[index]:.0%} the wall's back"
            )
        if outlook.clearance_mm[index] < limits.clearance_mm:
            return (
                f"is {outlook.clearance_mm[index]:.2f} mm from the wall (least: {limits.clearance_mm:g} mm)"
            )
        unknown = _unknown(outlook)[index]
        if unknown > limits.unknown:
            return f"sees {unknown:.0%} unseen, filled-in or missing surface (most: {limits.unknown:.0%})"
        return (
            f"is {findings.training_mm[index]:.1f} mm from the nearest training view (most: "
            f"{limits.training_mm:g} mm)"
        )


def _unknown(outlook: Outlook) -> np.ndarray:
    return outlook.unseen + outlook.filled + outlook.empty


def _training_views(twin: Twin, required: bool) -> cKDTree | None:
    """The places of the training frames; None where the sequence is gone and not ``required``."""
    try:
        sequence = twin.sequence()
    except SequenceError:
        if required:
            raise
        return None
    places = sequence.T_world_camera[twin.source.training(len(sequence)), :3, 3]
    return cKDTree(places) if len(places) else None

"""The path of the sequence that a twin was made from, and where to stand if it is gone."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from endotwin.errors import SequenceError, TrajectoryError
from endotwin.synth.trajectories.flight import FlightOptions, fly
from endotwin.synth.trajectories.lumen import Lumen
from endotwin.twin import Twin


def recorded_poses(twin: Twin) -> tuple[np.ndarray | None, str]:
    """Poses [N, 4, 4] of the twin's sequence, or None and the reason why there are none."""
    try:
        return twin.sequence().T_world_camera, ""
    except SequenceError:
        return None, f"no camera path: {Path(twin.source.path).name} is not where it was"


def path_or_flight(twin: Twin) -> np.ndarray:
    """Poses [N, 4, 4]: the recorded ones, else two of a flight through the lumen, else none."""
    poses, _ = recorded_poses(twin)
    if poses is not None:
        return poses
    try:
        return fly(FlightOptions(frames=2), Lumen(twin.surface), twin.camera, seed=0)[0]
    except TrajectoryError:
        return np.zeros((0, 4, 4))

"""Poses to render from: read, drawn or flown through the lumen."""

from endotwin.synth.trajectories.trajectory import Trajectory, parse_trajectory

__all__ = ["Trajectory", "parse_trajectory"]

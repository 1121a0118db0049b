"""Rendered datasets: trajectories through a twin, edits of its materials and light, and labelled frames."""

from endotwin.synth.dataset import Summary, synthesize
from endotwin.synth.edits import Edit, parse_light_edit, parse_material_edit
from endotwin.synth.trajectories import Trajectory, parse_trajectory

__all__ = [
    "Edit",
    "Summary",
    "Trajectory",
    "parse_light_edit",
    "parse_material_edit",
    "parse_trajectory",
    "synthesize",
]

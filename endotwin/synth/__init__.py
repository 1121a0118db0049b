"""Rendered datasets: trajectories through a twin, variation of it, and labelled frames."""

from endotwin.synth.fluids import with_fluids
from endotwin.synth.job import Job
from endotwin.synth.labels import DEFAULT_LABELS, LABELS, parse_labels
from endotwin.synth.layouts import LAYOUTS
from endotwin.synth.motion import Motion, parse_motion
from endotwin.synth.polyps import with_polyps
from endotwin.synth.proof import Proof, prove
from endotwin.synth.run.crew import Crew
from endotwin.synth.run.dataset import Summary, make_job, render_dataset, synthesize
from endotwin.synth.run.order import Order
from endotwin.synth.trajectories import Trajectory, parse_trajectory
from endotwin.synth.trajectories.screening import Limits
from endotwin.synth.variation import Variation, fixed, read_variation
from endotwin.synth.variation.edits import Edit, parse_light_edit, parse_material_edit
from endotwin.synth.variation.switches import equipped

__all__ = [
    "DEFAULT_LABELS",
    "LABELS",
    "LAYOUTS",
    "Crew",
    "Edit",
    "Job",
    "Limits",
    "Motion",
    "Order",
    "Proof",
    "Summary",
    "Trajectory",
    "Variation",
    "equipped",
    "fixed",
    "make_job",
    "parse_labels",
    "parse_light_edit",
    "parse_material_edit",
    "parse_motion",
    "parse_trajectory",
    "prove",
    "read_variation",
    "render_dataset",
    "synthesize",
    "with_fluids",
    "with_polyps",
]

"""What a caller asks a dataset to show, and the job that this comes to."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from endotwin.cameras import Camera, as_camera
from endotwin.run.arguments import as_path, check_whole, texts
from endotwin.synth.fluids import with_fluids
from endotwin.synth.job import Job
from endotwin.synth.labels import DEFAULT_LABELS, parse_labels
from endotwin.synth.motion import parse_motion
from endotwin.synth.polyps import with_polyps
from endotwin.synth.run.dataset import make_job
from endotwin.synth.trajectories import parse_trajectory
from endotwin.synth.trajectories.trajectory import kept_in
from endotwin.synth.variation import Variation, fixed, read_variation
from endotwin.synth.variation.edits import parse_light_edit, parse_material_edit
from endotwin.synth.variation.switches import equipped
from endotwin.twin import Twin, as_twin

if TYPE_CHECKING:
    import numpy as np

    from endotwin.synth.trajectories.screening import Limits


@dataclass(frozen=True)
class Order:
    """A dataset as its caller wants it; what each attribute may be, ``endotwin.synthesize`` says."""

    trajectory: str | Path | np.ndarray
    material: Iterable[str] | str = ()
    light: Iterable[str] | str = ()
    vary: Path | str | None = None
    camera: Camera | Path | str | None = None
    effects: Mapping[str, str] | None = None
    motion: Iterable[str] | str = ()
    polyps: Iterable[str] | str = ()
    fluids: Iterable[str] | str = ()
    labels: Iterable[str] | str | None = None
    layout: str = "c3vd"
    limits: Limits | None = None
    seed: int = 0

    def job(self, twin: Twin | Path | str, expected: Callable[[int], None] = lambda pixels: None) -> Job:
        """The job of rendering it from ``twin``; ``expected`` is told the pixels of all frames once they are
        known. Raises what ``endotwin.synthesize`` does."""
        twin = as_twin(twin)
        lens = twin.camera if self.camera is None else as_camera(self.camera)
        twin = equipped(twin, self.effects or {}, self.trajectory)
        seed = check_whole("seed", self.seed)
        variation = self._variation(twin)
        labels = self._labels(twin)
        poses = parse_trajectory(self.trajectory, twin, seed, lens, self.limits)
        expected(len(poses) * lens.width * lens.height)
        for added, specs in ((with_polyps, self.polyps), (with_fluids, self.fluids)):
            if specs:
                twin, weights = added(twin, specs, seed, poses, lens)
                variation, poses = variation.carried(weights), kept_in(poses, twin, lens)
        motion = parse_motion(self.motion, twin)
        if motion:
            poses = motion.carried(poses)
        return make_job(twin, poses, seed, labels, self.layout, lens, variation, motion)

    def _variation(self, twin: Twin) -> Variation:
        materials = [parse_material_edit(edit) for edit in texts("material", self.material)]
        always = fixed(materials, [parse_light_edit(edit) for edit in texts("light", self.light)])
        if self.vary is None:
            return always
        return read_variation(as_path("file of ranges", self.vary), twin, always)

    def _labels(self, twin: Twin) -> tuple[str, ...]:
        grows, wet = bool(self.polyps or twin.polyps), bool(self.fluids or twin.fluids)
        if self.labels is None:
            return (*DEFAULT_LABELS, *(("polyp",) if grows else ()), *(("fluid",) if wet else ()))
        return parse_labels(",".join(texts("labels", self.labels)), bool(self.motion), grows, wet)

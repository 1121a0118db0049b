"""The gains of a job's frames, where a camera would set them itself: by small pictures of each frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from endotwin.effects.auto_gain import AutoGain
from endotwin.render import Renderer
from endotwin.synth.job import Job
from endotwin.synth.labels import Labeller

EVERY = 3
"""Frames of which one is metered."""

METERED_PX = 64
"""Greatest side of the picture that is metered."""


def metered(job: Job) -> Job:
    """The job with the gain of each of its frames, 1 of those that set none."""
    labeller, camera = Labeller(job), job.camera
    small = camera.scaled(min(1.0, METERED_PX / max(camera.width, camera.height)))
    gains = np.ones(len(job))
    gain = wanted = None
    for index, time_s in enumerate(job.trajectory.timestamps_s):
        twin, _ = job.draws[index].edited(job.twin, job.regions)
        effect = twin.effects.get("auto_gain")
        if effect is None:
            gain = wanted = None
            continue
        if wanted is None or index % EVERY == 0:
            renderer = labeller.renderers(index)[0].through(small)
            wanted = _wanted(effect, renderer, job.trajectory.T_world_camera[index])
        since_s = time_s - job.trajectory.timestamps_s[index - 1] if index else 0.0
        gain = wanted if gain is None else effect.next(gain, wanted, since_s)
        gains[index] = gain
    return replace(job, gains=gains)


def _wanted(effect: AutoGain, renderer: Renderer, T_world_camera: np.ndarray) -> float:
    """The gain that ``effect`` wants for the view from a pose [4, 4]."""
    view = renderer.view(T_world_camera)
    gamma = renderer.twin.response.gamma
    return effect.wanted(float((view.radiance**gamma).mean()), gamma)

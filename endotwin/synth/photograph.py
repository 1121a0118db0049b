"""From a rendered view to the photo that a camera would have taken of it: exposure, optics, sensor,
processor, recorder.
"""

from __future__ import annotations

import numpy as np
import torch

from endotwin.effects import RENDERED
from endotwin.effects.exposure import Shot, expose
from endotwin.effects.video import Clip, Video
from endotwin.render import Renderer, View

EXPOSURE = ("motion_blur", "rolling_shutter")
OPTICS = ("defocus", "chromatic", "bloom", "lens")
"""In the order in which light meets them."""

RECORDING = ("processor", "overlay", "chroma", "codec", "video")
"""In the order in which the picture meets them."""


def photographed(
    renderer: Renderer,
    view: View,
    T_world_camera: np.ndarray,
    T_world_next: np.ndarray,
    generator: np.random.Generator,
    clip: Clip | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Display values and linear radiance float32 [H, W, 3] of ``view`` with the twin's rendered effects.

    Args:
        T_world_camera: the view's pose [4, 4]. T_world_next: that of one frame interval later: the velocity.
        generator: of the noise. clip: that the picture is the next one of; one of its own unless given.
    """
    effects, camera = renderer.twin.effects, renderer.camera
    if not set(effects) & set(RENDERED):
        return view.color, view.radiance
    timed = [effects[name] for name in EXPOSURE if name in effects]

    def seen(shot: Shot) -> torch.Tensor:
        """The radiance image on the sensor."""
        radiance = expose(arriving, shot, timed)
        for name in OPTICS:
            if name in effects:
                radiance = effects[name].through(radiance, view.depth_mm, camera)
        return radiance

    def arriving(T: np.ndarray, mask: np.ndarray | None) -> torch.Tensor:
        known = mask is None and T is T_world_camera
        return torch.from_numpy((view if known else renderer.view(T, mask)).radiance)

    shot = Shot(camera, T_world_camera, T_world_next, view.depth_mm)
    radiance = effects["interlacing"].woven(seen, shot) if "interlacing" in effects else seen(shot)
    color = renderer.twin.displayed(radiance).clamp(0, 1).numpy()
    if "noise" in effects:
        color = effects["noise"].read(color, generator)
    for effect in (effects[name] for name in RECORDING if name in effects):
        if isinstance(effect, Video):
            color = (clip or Clip()).recorded(color, effect)
        else:
            color = effect.recorded(color)
    return color, radiance.numpy()

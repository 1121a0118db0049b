"""What each effect of a twin costs: milliseconds a frame, megabytes."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from endotwin.effects import RENDERED, Decision
from endotwin.effects.lens import Lens
from endotwin.render.renderer import Renderer

if TYPE_CHECKING:
    from endotwin.light.radiosity import Radiosity
    from endotwin.pixels.samples import Views
    from endotwin.surface.casting import Caster
    from endotwin.twin import Twin

FREE = ("specular", "gain")
"""Part of every rendering, and of none."""

LEAST_S = 0.3
"""Renderings are repeated for so long: the best of several small ones, a single large one."""


def priced(twin: Twin, caster: Caster, views: Views, radiosity: Radiosity | None = None) -> Twin:
    """``twin`` with the price of each effect that is on in its decisions, by the middle one of ``views``, and
    those only rendered in them too. ``caster`` and ``radiosity`` as of ``Renderer``."""
    decisions = {**_rendered(views), **twin.decisions}
    pose = twin.surface.to_world(views.T_local_camera[len(views.frames) // 2])
    dear = [name for name in twin.effects if name in decisions and name not in FREE]
    if dear:
        whole = Renderer(twin, caster=caster, radiosity=radiosity)
        whole_ms = frame_ms(whole, pose)
        for name in dear:
            gone = {"offset": ("offset", "shadows")}.get(name, (name,))
            other_ms = frame_ms(whole.edited(replace(twin, effects=twin.effects.without(gone))), pose)
            decisions[name] = replace(
                decisions[name],
                render_ms=round(max(0.0, whole_ms - other_ms), 1),
                memory_mb=round(whole.nbytes / 1e6, 1) if name == "interreflection" else 0.0,
            )
    return replace(twin, decisions=decisions)


def frame_ms(renderer: Renderer, T_world_camera: np.ndarray) -> float:
    """Milliseconds of the view from ``T_world_camera`` [4, 4], less what is found once for all views: a pixel
    is rendered before."""
    pixel = np.zeros((renderer.camera.height, renderer.camera.width), bool)
    pixel[renderer.camera.height // 2, renderer.camera.width // 2] = True
    renderer.view(T_world_camera, pixel)
    return best_ms(lambda: renderer.view(T_world_camera))


def best_ms(render: Callable[[], object]) -> float:
    """Milliseconds of the fastest of some calls of ``render``."""
    times_s: list[float] = []
    while sum(times_s) < LEAST_S:
        began = time.perf_counter()
        render()
        times_s.append(time.perf_counter() - began)
    return 1e3 * min(times_s)


def _rendered(views: Views) -> dict[str, Decision]:
    """Decisions of the effects that no fit needs: the lens is seen at once, the others are rendered on
    request."""
    lens, reason = Lens.told_by(views.camera, views.lens_mask)
    decisions = {
        name: Decision("off", f"rendered on request: synth --effects {name}=on") for name in RENDERED
    }
    return {**decisions, "lens": Decision("off" if lens is None else "on", reason)}

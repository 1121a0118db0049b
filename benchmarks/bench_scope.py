"""Frames a second of the inspector's scope: ``python benchmarks/bench_scope.py TWIN [--frames N]``.

The scope flies ahead and turns; every frame is drawn as the window draws it, once at 320×240 and once as the
window chooses.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import psutil

from endotwin.look.scope import QUICK_PX, Scope
from endotwin.render import Renderer
from endotwin.twin import Twin

PANE = (864, 1080)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("twin", type=Path)
    parser.add_argument("--frames", type=int, default=60)
    arguments = parser.parse_args()
    twin = Twin.load(arguments.twin)
    scope = Scope(twin)
    camera = twin.camera
    small = camera.scaled(min(1.0, (QUICK_PX / (camera.width * camera.height)) ** 0.5))
    renderer = Renderer(twin, small)
    print(f"{twin.surface}; load {psutil.getloadavg()[0]:.1f}")
    report(
        f"{small.width}×{small.height}, rendered", scope, arguments.frames, lambda: renderer.view(scope.pose)
    )
    report("as the window draws", scope, arguments.frames, lambda: scope.picture(PANE, quick=True))


def report(what: str, scope: Scope, frames: int, draw) -> None:
    """Print the rate of ``draw`` along a flight."""
    scope.go_to(0)
    draw()
    times_s = []
    for _ in range(frames):
        scope.move(ahead_mm=0.1)
        scope.turn(right=0.005)
        began, used = time.perf_counter(), time.process_time()
        draw()
        times_s.append((time.perf_counter() - began, time.process_time() - used))
    wall_s, cpu_s = np.median(times_s, axis=0)
    print(f"{what}: {1 / wall_s:.1f} frames/s (median), {1e3 * cpu_s:.0f} ms of processor time a frame")


if __name__ == "__main__":
    main()

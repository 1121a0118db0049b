"""Frames a second and peak memory of synth: ``python benchmarks/bench_synth.py TWIN [FRAMES ...]``."""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from endotwin.stopwatch import peak_memory_mb
from endotwin.synth import parse_trajectory, synthesize
from endotwin.twin import Twin


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("twin", type=Path, help="a fitted twin whose sequence is still there")
    parser.add_argument("frames", type=int, nargs="*", default=[50, 200], help="sizes of the datasets")
    parser.add_argument("--rounds", type=int, default=3, help="times that each is made; the best counts")
    arguments = parser.parse_args()
    twin = Twin.load(arguments.twin)
    size = f"{twin.camera.width}×{twin.camera.height}"
    print(f"{twin.surface}, {size}; memory before: {peak_memory_mb():.0f} MB")
    for frames in arguments.frames:
        trajectory = parse_trajectory(f"jitter:frames={frames}", twin, seed=0)
        wall, cpu = [], []
        for _ in range(arguments.rounds):
            with tempfile.TemporaryDirectory() as folder:
                start = time.perf_counter(), time.process_time()
                summary = synthesize(twin, trajectory, Path(folder) / "dataset")
                wall.append(time.perf_counter() - start[0])
                cpu.append(time.process_time() - start[1])
        print(
            f"{frames} frames, best of {arguments.rounds}: {frames / min(wall):.1f} frames/s, "
            f"{min(cpu) / frames * 1e3:.0f} ms of one core each, "
            f"{summary.bytes / frames / 1e6:.2f} MB a frame, peak memory {peak_memory_mb():.0f} MB"
        )


if __name__ == "__main__":
    main()

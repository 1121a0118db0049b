"""Prints what fusion and casting do in a second: ``python benchmarks/bench_fusion.py SEQUENCE``."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from endotwin.fusion import fuse
from endotwin.fusion.agreement import Tolerance, agreement
from endotwin.fusion.faces import split
from endotwin.fusion.tsdf import fuse_tsdf
from endotwin.fusion.views import read_views
from endotwin.run.stopwatch import peak_memory_mb
from endotwin.sequence import Sequence
from endotwin.sequence.readers import open_sequence
from endotwin.surface import Surface
from endotwin.surface.casting import Caster

VOXEL_MM = 0.5
CAST_BATCHES, CAST_BATCH = 16, 4


def print_casting(sequence: Sequence, surface: Surface) -> None:
    """The rate of casting the sequence's own views, in batches: the best tells of the code, the median of
    the machine."""
    camera, caster = sequence.camera, Caster(surface)
    rays = CAST_BATCH * camera.width * camera.height
    wall, cpu = [], []
    for batch in range(CAST_BATCHES):
        poses = sequence.T_world_camera[np.arange(batch, batch + CAST_BATCH) * 7 % len(sequence)]
        start = time.perf_counter(), time.process_time()
        for T_world_camera in poses:
            caster.cast(camera, T_world_camera)
        wall.append(time.perf_counter() - start[0])
        cpu.append(time.process_time() - start[1])
    million = 1e-6 * rays
    print(
        f"casting: best {million / min(wall):.1f}, median {million / np.median(wall):.1f} million rays/s, "
        f"{million / min(cpu):.1f} a core-second, onto {len(surface.triangles):,} triangles"
    )


def main(path: Path) -> None:
    sequence = open_sequence(path)
    camera, frames = sequence.camera, range(len(sequence))
    origin_mm = sequence.T_world_camera[:, :3, 3].mean(axis=0)

    start = time.perf_counter()
    fuse_tsdf(split(camera), read_views(sequence, frames), origin_mm, VOXEL_MM, noise_mm=0.0)
    seconds = time.perf_counter() - start
    print(f"TSDF at {VOXEL_MM} mm, decoding included: {len(frames) / seconds:.1f} frames/s")

    stages: dict[str, float] = {}
    last = time.perf_counter()

    def progress(stage: str, done: int, total: int) -> None:
        nonlocal last
        now = time.perf_counter()
        stages[stage] = stages.get(stage, 0.0) + now - last
        last = now

    start = time.perf_counter()
    surface = fuse(sequence, progress=progress)
    print(f"fuse: {time.perf_counter() - start:.1f} s, {surface}")
    print("  " + ", ".join(f"{stage} {seconds:.1f} s" for stage, seconds in stages.items()))
    print_casting(sequence, surface)
    found = agreement(camera, surface, read_views(sequence, frames), Tolerance(0.3, 0.01))
    print(
        f"pixels that disagree: {1 - found.agrees:.3%} (miss {found.misses:.3%}, "
        f"see through {found.sees_through:.3%}, membrane {found.membrane:.3%})"
    )
    print(f"covered vertices: {np.mean(surface.seen_by > 0):.1%}")
    print(f"peak memory: {peak_memory_mb() / 1000:.2f} GB")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sequence", type=Path)
    main(parser.parse_args().sequence)

"""Frames a second and memory of synth: ``python benchmarks/bench_synth.py TWIN --frames N --workers N``."""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path

import psutil

from endotwin.synth import DEFAULT_LABELS, parse_labels, parse_motion, parse_trajectory, synthesize
from endotwin.twin import Twin

PAPER_FRAMES = 18_000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("twin", type=Path, help="a fitted twin whose sequence is still there")
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--labels", default=",".join(DEFAULT_LABELS))
    parser.add_argument("--layout", default="c3vd")
    parser.add_argument("--trajectory", default="jitter", help="its kind")
    parser.add_argument("--motion", action="append", default=[], help="of the tissue, as synth takes it")
    parser.add_argument(
        "--folder", type=Path, help="where to write; the system's temporary folder unless given"
    )
    arguments = parser.parse_args()
    twin = Twin.load(arguments.twin)
    started = time.perf_counter()
    trajectory = parse_trajectory(f"{arguments.trajectory}:frames={arguments.frames}", twin, seed=0)
    motion = parse_motion(arguments.motion, twin)
    if motion:
        trajectory = motion.carried(trajectory)
    drawn_s = time.perf_counter() - started
    memory_mb, first = [], []

    def progress(label: str, done: int, total: int) -> None:
        first.append((time.perf_counter(), done))
        memory_mb.append(memory_of_all_mb())

    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        started, cpu_s = time.perf_counter(), all_cpu_s()
        summary = synthesize(
            twin,
            trajectory,
            Path(folder) / "dataset",
            labels=parse_labels(arguments.labels, motion is not None),
            motion=motion,
            layout=arguments.layout,
            workers=arguments.workers,
            progress=progress,
        )
        wall_s, cpu_s = time.perf_counter() - started, all_cpu_s() - cpu_s
    (began, done), (ended, total) = first[0], first[-1]
    rate = (total - done) / (ended - began) if ended > began else 0
    quarter = max(len(memory_mb) // 4, 1)
    size = f"{twin.camera.width}×{twin.camera.height}"
    print(
        f"{twin.surface}, {size}; {arguments.layout}: {arguments.labels}; load {psutil.getloadavg()[0]:.1f}"
    )
    print(f"poses drawn and judged in {drawn_s:.1f} s; {summary}")
    print(
        f"{arguments.workers} workers: {wall_s:.1f} s with their start, "
        f"{arguments.frames / wall_s:.1f} frames/s; {rate:.1f} frames/s once at work, "
        f"{PAPER_FRAMES} frames in {PAPER_FRAMES / rate / 60:.1f} min; "
        f"{cpu_s / arguments.frames * 1e3:.0f} ms of a core each"
    )
    print(
        f"memory of all processes: {max(memory_mb[:quarter]):.0f} MB at most in the first quarter, "
        f"{max(memory_mb[-quarter:]):.0f} MB in the last"
    )


def all_cpu_s() -> float:
    """Seconds of cores that this process and its ended children took."""
    return sum(os.times()[:4])


def memory_of_all_mb() -> float:
    """Resident memory of this process and its children, MB."""
    this = psutil.Process()
    return sum(each.memory_info().rss for each in [this, *this.children(recursive=True)]) / 1e6


if __name__ == "__main__":
    main()

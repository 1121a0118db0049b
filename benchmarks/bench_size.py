"""What a sequence of C3VD's size costs: ``python benchmarks/bench_size.py TWIN --frames 300 1000``.

Renders sequences from a fitted twin with ``endotwin synth``, along a path through the poses of its own
sequence, fuses and fits each, and scores it on its held-out frames. Seconds of cores are printed beside those
of the wall clock: only where nothing else runs do both tell the same. With ``--every-frame`` each sequence
has a second row, for which no frame was left out of the fusion: what leaving them out costs.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from endotwin.sequence.poses import write_c3vd_poses
from endotwin.twin import Twin

COLUMNS = (
    "frames",
    "size",
    "fused",
    "fuse",
    "fuse, cores",
    "fit",
    "fit, cores",
    "memory",
    "PSNR",
    "PSNR covered",
)

COMMAND = ("-m", "endotwin.cli.start")
EVERY_FRAME = (
    "-c",
    "import endotwin.cli.main as cli, endotwin.fusion as f; f.WORTH_PIXELS = 1e99; cli.main()",
)
"""The same command, to which every frame of any sequence is worth fusing."""


def run(*arguments: object, command: tuple[str, str] = COMMAND) -> tuple[float, float, str]:
    """Seconds of the wall clock, seconds of cores, and what was printed, of one command."""
    started, before = time.perf_counter(), os.times()
    words = [sys.executable, *command, *map(str, arguments)]
    printed = subprocess.run(words, stdout=subprocess.PIPE, check=True, text=True, encoding="utf-8").stdout
    after = os.times()
    cores_s = after.children_user + after.children_system - before.children_user - before.children_system
    return time.perf_counter() - started, cores_s, printed


def rendered(twin: Path, frames: int, folder: Path) -> Path:
    """A sequence of so many frames along the path of the twin's own, in ``folder``."""
    made, poses = folder / f"{twin.resolve().name}-{frames}", folder / "path.txt"
    if not made.exists():
        write_c3vd_poses(poses, Twin.load(twin).sequence().T_world_camera)
        path = f"spline:{poses},frames={frames}"
        run("synth", twin, "--trajectory", path, "--labels", "rgb,depth", "--workers", 0, "-o", made)
    return made


def measured(sequence: Path, scale: float, work: Path, command: tuple[str, str]) -> dict[str, str]:
    """One row of the table, with ``command`` for the fusion."""
    twin, profile = work / "twin", work / "profile.json"
    options = "--scale", scale, "--overwrite", "--profile", profile
    fuse = run("fuse", sequence, "-o", twin, *options, command=command)
    peaks = [json.loads(profile.read_text())["peak_memory_mb"]]
    fit = run("fit", twin, "--overwrite", "--profile", profile)
    peaks.append(json.loads(profile.read_text())["peak_memory_mb"])
    scores = json.loads(run("eval", twin, "--json")[2])
    loaded = Twin.load(twin)
    made = loaded.record["fuse"]
    cells = [made["frames"], f"{loaded.camera.width}×{loaded.camera.height}", len(made["fused"])]
    cells += [f"{seconds:.0f} s" for seconds in (*fuse[:2], *fit[:2])]
    cells += [f"{max(peaks) / 1000:.1f} GB", f"{scores['psnr']:.2f} dB", f"{scores['psnr_covered']:.2f} dB"]
    return dict(zip(COLUMNS, map(str, cells), strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("twin", type=Path, help="a fitted twin whose sequence is still there")
    parser.add_argument("--frames", type=int, nargs="+", default=[300])
    parser.add_argument("--scale", type=float, default=1.0, help="factor on the image size, of fuse and fit")
    parser.add_argument("--every-frame", action="store_true", help="a second row, of all frames fused")
    parser.add_argument("--folder", type=Path, help="where sequences are kept; unless given, they are not")
    options = parser.parse_args()
    commands = (COMMAND, EVERY_FRAME) if options.every_frame else (COMMAND,)
    print("|", " | ".join(COLUMNS), "|\n|", " | ".join("---" for _ in COLUMNS), "|")
    with tempfile.TemporaryDirectory() as work:
        folder = options.folder or Path(work)
        folder.mkdir(parents=True, exist_ok=True)
        for frames in options.frames:
            sequence = rendered(options.twin, frames, folder)
            for command in commands:
                row = measured(sequence, options.scale, Path(work), command)
                print("|", " | ".join(row.values()), "|", flush=True)


if __name__ == "__main__":
    main()

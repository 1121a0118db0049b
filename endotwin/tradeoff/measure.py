"""One measurement: the real commands, each in a process of its own, from cold files."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path

from endotwin.config import to_yaml
from endotwin.errors import EndotwinError
from endotwin.run.output import whole_file
from endotwin.tradeoff.ladder import Rung

SCORES = ("psnr", "ssim", "lpips", "psnr_covered", "covered")


class RungError(EndotwinError):
    """A rung's command failed."""


def cool(files: Iterable[Path]) -> None:
    """Drop ``files`` from the page cache, so that they are read from the disk again; Linux only."""
    if not hasattr(os, "posix_fadvise"):
        return
    for file in files:
        descriptor = os.open(file, os.O_RDONLY)
        os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
        os.close(descriptor)


def timed(arguments: list[str], files: Iterable[Path], work: Path) -> tuple[str, dict]:
    """Run one endotwin command in ``work``, with ``files`` cold: what it printed, and its cost.

    Returns:
        stdout; ``{"seconds": wall-clock with Python's start, "stages", "parts", "peak_memory_mb"}``.

    Raises:
        RungError: the command failed; says what it said.
    """
    profile = work / "profile.json"
    cool(files)
    command = [sys.executable, "-m", "endotwin.cli.start", *arguments, "--profile", str(profile)]
    started = time.perf_counter()
    done = subprocess.run(command, cwd=work, capture_output=True, text=True, encoding="utf-8")
    seconds = time.perf_counter() - started
    if done.returncode:
        said = done.stderr.strip().splitlines() or ["nothing"]
        raise RungError(f"endotwin {' '.join(arguments)} failed and said: {said[-1]}")
    return done.stdout, {**json.loads(profile.read_text(encoding="utf-8")), "seconds": seconds}


def measured(commands: list[list[str]], files: Sequence[Path], work: Path) -> dict:
    """Make and score one twin of the sequence with ``files``, in ``work``/twin, which is left there.

    Args:
        commands: those that make it, fuse and fit or fit alone; and the one that scores it.

    Returns:
        ``{"seconds": of making it, "stages": {stage: s}, "peak_memory_mb", scores..., "load": before}``.
    """
    *making, scoring = commands
    shutil.rmtree(work / "twin", ignore_errors=True)
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    costs = [timed(command, files, work)[1] for command in making]
    printed, _ = timed(scoring, files, work)
    scores = json.loads(printed)
    return {
        "seconds": sum(cost["seconds"] for cost in costs),
        "stages": stages(*costs),
        "peak_memory_mb": max(cost["peak_memory_mb"] for cost in costs),
        **{name: scores[name] for name in SCORES},
        "load": load,
    }


def stages(*profiles: dict) -> dict[str, float]:
    """Seconds of the parts of fuse and fit; what belongs to none (imports, files) is ``start``-up.

    A part that is done again adds to its first.
    """
    shares: dict[str, float] = {"start-up and files": 0.0}
    for profile in profiles:
        inside = 0.0
        for name, seconds in profile["parts"].get(profile["command"], {}).items():
            known = STAGES.get(name.removesuffix(" again"), name.removesuffix(" again"))
            shares[known] = shares.get(known, 0.0) + seconds
            inside += seconds
        shares["start-up and files"] += max(0.0, profile["seconds"] - inside)
    return shares


STAGES = {
    "import": "start-up and files",
    "open": "start-up and files",
    "voxel size": "TSDF",
    "noise": "TSDF",
    "start": "closed form",
}
"""Parts that go under another name in the plot."""


def due(rung: Rung, repeat: int, work: Path) -> tuple[Path, dict, str] | None:
    """A run that is still to be measured: where its result goes, what was asked, and its config as commands
    name it, written below ``work``; None: it is there."""
    result, asked = work / "results" / f"{rung.name}.{repeat}.json", {"config": asdict(rung.config)}
    if kept(result, asked):
        return None
    file = work / "rungs" / f"{rung.name}.yaml"
    file.write_text(to_yaml(rung.config), encoding="utf-8")
    return result, asked, rung.given or str(file.resolve())


def kept(path: Path, asked: dict) -> bool:
    """Whether ``path`` holds what was measured for ``asked``."""
    return path.exists() and json.loads(path.read_text(encoding="utf-8")).items() >= asked.items()


def keep(result: dict, path: Path) -> None:
    """Write one measurement whole or not at all."""
    with whole_file(path, overwrite=True) as file:
        file.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")

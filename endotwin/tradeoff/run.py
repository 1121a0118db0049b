"""The run: every rung as often as asked, each result kept as soon as it is there."""

from __future__ import annotations

import platform
import shutil
from collections.abc import Callable
from pathlib import Path

from endotwin.errors import OptionError, OutputError
from endotwin.pipeline import GEOMETRIES
from endotwin.run.output import TRADEOFF, check_free, goes_on, move_folder, unwritable
from endotwin.run.threads import cores
from endotwin.sequence import Sequence
from endotwin.sequence.fingerprints import checksum, fingerprints
from endotwin.sequence.readers import open_sequence
from endotwin.tradeoff import crops, effects, plot, report
from endotwin.tradeoff.ladder import Rung
from endotwin.tradeoff.measure import due, keep, measured
from endotwin.tradeoff.summary import summary, write_csv
from endotwin.twin import Source

Progress = Callable[[str, int, int], None]

PARTIAL = ".partial"
OWN = ("tradeoff", "effects", "ladder", "rungs", "results", "crops")
"""First parts of the names that a finished folder holds."""


def tradeoff(
    path: Path,
    out: Path,
    rungs: list[Rung],
    repeats: int = 3,
    geometry: str = "known",
    overwrite: bool = False,
    progress: Progress | None = None,
    base: Rung | None = None,
) -> tuple[list[dict], list[dict]]:
    """Measure ``rungs`` on the sequence at ``path`` and write table, plot and page to the folder ``out``.

    Until all is measured the results lie in ``out.partial``; the same call goes on from there. Repeats go
    round the ladder, so that a machine that is busy for a while slows all rungs alike; each has a seed of its
    own.

    Args:
        base: the rung that is also fitted with each effect forced the other way; None: no such pages.

    Returns:
        one row a rung, as ``summary`` makes them; one row an effect, as ``effects.rows`` does.

    Raises:
        OptionError: no such geometry. SequenceError: no such sequence, or a frame of it cannot be read.
        OutputError: ``out`` is taken, or ``out.partial`` is another sequence's. RungError: a command failed;
        what was measured before stays in ``out.partial``.
    """
    check_free(out, overwrite, TRADEOFF)
    if geometry not in GEOMETRIES:
        raise OptionError(f"geometry {geometry!r} is unknown; choose one of {', '.join(GEOMETRIES)}")
    sequence = open_sequence(path)
    sequence.require_valid_depth()
    asked = {
        "sequence": str(path.resolve()),
        "checksum": checksum(sequence, fingerprints(sequence)),
        "geometry": geometry,
    }
    patch = crops.telling_patch(sequence, Source(str(path), sequence.format))
    work = out.with_name(out.name + PARTIAL)
    try:
        _enter(work, asked)
        return _climbed(sequence, path, patch, work, out, rungs, repeats, geometry, progress, base)
    except OSError as error:
        told = unwritable(Path(error.filename or work), error)
        raise OutputError(f"{told}; the same command goes on from {work}") from error


def _climbed(
    sequence: Sequence,
    path: Path,
    patch: crops.Patch,
    work: Path,
    out: Path,
    rungs: list[Rung],
    repeats: int,
    geometry: str,
    progress: Progress | None,
    base: Rung | None,
) -> tuple[list[dict], list[dict]]:
    """What ``tradeoff`` does, in the folder ``work`` and at last in ``out``."""
    runs = [(repeat, rung) for repeat in range(repeats) for rung in rungs]
    try:
        for done, (repeat, rung) in enumerate(runs):
            if progress:
                progress(f"{rung.name}, run {repeat + 1} of {repeats}", done, len(runs))
            _measure(rung, repeat, sequence, geometry, work, patch)
        cases = base and effects.measure(base, sequence, repeats, geometry, work / "effects", progress)
    except BaseException as stopped:
        stopped.add_note(f"the same command goes on from {work}")
        raise
    if progress:
        progress("report", len(runs), len(runs))
    rows = [summary(rung, repeats, work, out, path, geometry) for rung in rungs]
    by_effect = []
    if cases:
        places = work / "effects", out / "effects"
        by_effect = effects.rows(cases, repeats, *places, path, geometry)
        write_csv(by_effect, work / "effects.csv")
        plot.draw_effects(by_effect, [work / "effects.png", work / "effects.svg"])
    crops.save(crops.photo(sequence, patch), work / "crops" / "photo.png")
    size = f"{sequence.camera.width}×{sequence.camera.height}"
    facts = {
        "sequence": f"{len(sequence)} frames at {size} through a {sequence.camera.model} camera",
        "name": path.name,
        "geometry": geometry,
        "repeats": repeats,
        "machine": machine(),
        "patch": f"frame {sequence.color_files[patch.frame].name}, {patch.size}×{patch.size} pixels "
        f"at column {patch.column}, row {patch.row}",
    }
    write_csv(rows, work / "tradeoff.csv")
    plot.draw(rows, [work / "tradeoff.png", work / "tradeoff.svg"])
    report.write(rows, by_effect, facts, work)
    for place in (work, work / "effects"):
        for name in ("twin", "fused", "fused.json", "profile.json"):
            entry = place / name
            shutil.rmtree(entry) if entry.is_dir() else entry.unlink(missing_ok=True)
    move_folder(work, out, lambda name: name.parts[0].partition(".")[0] in OWN)
    return rows, by_effect


def _enter(work: Path, asked: dict) -> None:
    """Make the working folder, or go on in it if it was made for the same frames and geometry."""
    if goes_on(work, TRADEOFF, asked, "another sequence or geometry, or of other frames"):
        return
    for folder in ("rungs", "results", "crops"):
        (work / folder).mkdir(parents=True, exist_ok=True)
    keep(asked, work / TRADEOFF)


def _measure(
    rung: Rung, repeat: int, sequence: Sequence, geometry: str, work: Path, patch: crops.Patch
) -> None:
    """Measure one run of a rung and keep it, unless that was done; the first one's crop is kept too."""
    if (run := due(rung, repeat, work)) is None:
        return
    result, asked, config = run
    commands = rung.commands(sequence.path.resolve(), config, geometry, repeat)
    measurement = measured(commands, [*sequence.color_files, *sequence.depth_files], work.resolve())
    if repeat == 0:
        crops.save(crops.render(work / "twin", patch), work / "crops" / f"{rung.name}.png")
    keep({**asked, **measurement}, result)


def machine() -> str:
    """What it was measured on, in words; of its cores, those that this process may use."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = [
            line for line in info.read_text(encoding="utf-8").splitlines() if line.startswith("model name")
        ]
        model = lines[0].split(":", 1)[1].strip() if lines else model
    return f"{cores()} cores, {model}, {platform.system()}"

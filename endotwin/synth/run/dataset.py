"""A twin and a trajectory become a labelled dataset: in shards, by any number of workers, resumable."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from endotwin.cameras import Camera
from endotwin.effects.video import CLIP_FRAMES, Video
from endotwin.errors import EndotwinError, OptionError, OutputError
from endotwin.run.output import DATASET, check_apart, unwritable
from endotwin.run.processes import Pool
from endotwin.sequence.poses import TIME_DIGITS
from endotwin.synth.encodings import FLOW_RANGE_PX
from endotwin.synth.job import Job
from endotwin.synth.labels import DEFAULT_LABELS, LABELS, OF_MOTION
from endotwin.synth.layouts import LAYOUTS
from endotwin.synth.metering import metered
from endotwin.synth.motion import Motion
from endotwin.synth.proof import Proof, Written, prove
from endotwin.synth.proof.written import read_records
from endotwin.synth.run import crew
from endotwin.synth.run.datasheet import write_datasheet
from endotwin.synth.run.partial import Partial
from endotwin.synth.run.record import describe
from endotwin.synth.run.shard import done_shards, frame_record, total
from endotwin.synth.trajectories import Trajectory
from endotwin.synth.variation import Variation
from endotwin.synth.variation.switches import SUCCESSIVE
from endotwin.twin import Twin

PROOF_PAIRS = 2
"""Pairs of frames whose labels are compared for the datasheet; ``endotwin check --labels`` takes more."""

EXTREME = 0.95
"""Share of black or saturated pixels from which a dataset shows nothing."""

logger = logging.getLogger("endotwin")


@dataclass(frozen=True)
class Summary:
    """What ``synthesize`` wrote.

    Attributes:
        path: the dataset's folder. frames: how many. bytes: size of all of its files.
        valid: share of the pixels that show surface which the training photos show, over all frames; None
            where no mask was asked for.
        advice: what another program must be told to read it; empty where there is nothing.
    """

    path: Path
    frames: int
    bytes: int
    valid: float | None
    advice: str = ""

    def __str__(self) -> str:
        size = f"{self.bytes / 1e6:.1f} MB"
        valid = "" if self.valid is None else f", {self.valid:.1%} of the pixels valid"
        return f"{self.path}: {self.frames} frames, {size}{valid}{self.advice and f'; {self.advice}'}"


def synthesize(
    twin: Twin,
    trajectory: Trajectory,
    out: Path | str,
    *,
    seed: int = 0,
    labels: tuple[str, ...] = DEFAULT_LABELS,
    layout: str = "c3vd",
    camera: Camera | None = None,
    variation: Variation | None = None,
    motion: Motion | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    overwrite: bool = False,
    progress: Callable[[str, int, int], None] | None = None,
) -> Summary:
    """Render ``trajectory`` with the varied twin.

    The same arguments give the same bytes on the same machine, with any number of workers. A run that stops
    leaves ``OUT.partial``, and the same call goes on there; ``out`` itself appears when it is whole.

    Args:
        out: folder to make; replaced if it exists and ``overwrite`` is true.
        seed: of what ``variation`` draws; kept in ``dataset.json``.
        labels: names among ``LABELS``. layout: a name among ``LAYOUTS``.
        camera: to render through; the twin's own unless given.
        motion: of the tissue, on whose moving lumen the trajectory was ``carried``; still unless given.
        workers: processes; 1 renders in this one. 0: as many as there are cores, where it is worth it.
        scheduler: address of a Dask scheduler to render on, such as ``tcp://host:8786``.
        progress: called with (label, done, total).

    Raises:
        TwinError: the twin is not fitted. OptionError: a layout does not fit the camera or the labels.
        OutputError: ``out`` exists, another job is unfinished there, or it cannot be written.
    """
    camera, variation = camera or twin.camera, variation or Variation()
    job = make_job(twin, trajectory, seed, labels, layout, camera, variation, motion)
    return render_dataset(job, out, workers, scheduler, overwrite, progress)


def render_dataset(
    job: Job,
    out: Path | str,
    workers: int = 1,
    scheduler: str | None = None,
    overwrite: bool = False,
    progress: Callable[[str, int, int], None] | None = None,
    pool: Pool | None = None,
) -> Summary:
    """Do a job; arguments and errors are those of ``synthesize``. ``pool``: of processes that are there."""
    check_apart(Path(out), [job.twin.source.path])
    partial = Partial(Path(out))
    with partial.claimed(job.digest(), overwrite) as finished:
        if not finished:
            with _resumable(partial):
                _render(job, partial, workers, scheduler, progress, pool)
                _finish(job, partial)
    return _summary(Path(out))


def make_job(
    twin: Twin,
    trajectory: Trajectory,
    seed: int,
    labels: tuple[str, ...],
    layout: str,
    camera: Camera,
    variation: Variation,
    motion: Motion | None = None,
) -> Job:
    """The job of ``synthesize``'s arguments; raises TwinError or OptionError where they do not fit."""
    twin.require_fitted()
    if layout not in LAYOUTS:
        raise OptionError(f"there is no layout {layout!r}; choose one of {', '.join(LAYOUTS)}")
    still = [label for label in labels if motion is None and label in OF_MOTION]
    if still:
        raise OptionError(f"the label {still[0]} needs tissue that moves; ask for motion too (--motion)")
    if "polyp" in labels and not twin.polyps:
        raise OptionError("the label polyp needs polyps; ask for some too (--polyp)")
    if "fluid" in labels and not twin.fluids:
        raise OptionError("the label fluid needs a fluid; ask for one too (--fluid)")
    refusal = LAYOUTS[layout].refusal(camera, labels)
    if refusal:
        raise OptionError(f"layout {layout}: {refusal}")
    if LAYOUTS[layout].by_time and (np.diff(trajectory.timestamps_s.round(TIME_DIGITS)) <= 0).any():
        raise OptionError(f"layout {layout}: the times of the poses do not rise; give each a later one")
    draws = variation.draw(trajectory.originals, seed)
    used = {*twin.effects, *(name for draw in draws for name, on in draw.effects if on)}
    moving = [name for name in SUCCESSIVE if name in used]
    if moving and not trajectory.successive:
        raise OptionError(f"{moving[0]} needs poses that follow each other, and those of jitter do not")
    filmed = "video" in used
    if filmed:
        Video.require_encoder()
    job = Job(
        twin=twin,
        camera=camera,
        trajectory=trajectory,
        draws=draws,
        regions=variation.regions,
        labels=labels,
        images=tuple(dict.fromkeys(image for label in labels for image in LABELS[label])),
        layout=layout,
        shard_frames=max(LAYOUTS[layout].shard_frames, CLIP_FRAMES if filmed else 0),
        document=describe(twin, trajectory, seed, labels, layout, camera, variation, motion, filmed),
        motion=motion,
    )
    return metered(job) if "auto_gain" in used else job


def _render(
    job: Job,
    partial: Partial,
    workers: int,
    scheduler: str | None,
    progress: Callable[[str, int, int], None] | None,
    pool: Pool | None,
) -> None:
    """Render the shards that are not done yet."""
    done = done_shards(partial.path)
    pending = [number for number in range(job.shards) if number not in done]
    frames = sum(len(job.shard(number)) for number in done)
    if progress and done:
        progress("render", frames, len(job))
    if not pending:
        return
    workers = crew.enough(workers, (len(job) - frames) * job.camera.width * job.camera.height)
    workers = min(workers, len(pending))
    if scheduler:
        rendered = crew.render_on_cluster(job, partial.path, pending, scheduler)
    elif workers > 1:
        rendered = crew.render_in_processes(job, partial.path, pending, pool or Pool(workers))
    else:
        rendered = crew.render_here(job, partial.path, pending)
    for number in rendered:
        frames += len(job.shard(number))
        if progress:
            progress("render", frames, len(job))


def _finish(job: Job, partial: Partial) -> None:
    """Write what belongs to all frames, and put the dataset in its place."""
    statistics = total(list(done_shards(partial.path).values()))
    _doubt_exposure(statistics.brightness)
    _doubt_flow(statistics.flow)
    folder = partial.data
    layout = LAYOUTS[job.layout]
    layout.tables(folder, job)
    with (folder / "frames.jsonl").open("w", encoding="utf-8") as file:
        for index in range(len(job)):
            file.write(json.dumps(frame_record(job, index)) + "\n")
    if {"triangles", "vertices"} & set(job.labels):
        import trimesh  # which takes most of a second, and few datasets call for

        surface = job.twin.surface
        points = surface.vertices_mm.astype("float64") + surface.origin_mm
        trimesh.Trimesh(points, surface.triangles, process=False).export(folder / "surface.ply")
    document = {**job.document, "coverage": statistics.mean_coverage()}
    write_datasheet(folder / "datasheet.html", document, statistics, _proof(folder, document))
    document["files"] = sorted({*partial.kinds(), DATASET})
    text = json.dumps(document, indent=1, ensure_ascii=False) + "\n"
    (folder / DATASET).write_text(text, encoding="utf-8", errors="backslashreplace")
    partial.finish()


def _proof(folder: Path, document: dict) -> Proof:
    """What some frames prove of the labels; a warning where they do not agree."""
    proof = prove(Written(folder, document, read_records(folder)), PROOF_PAIRS)
    if not proof.holds:
        logger.warning("the labels do not agree: it is not so that %s", "; or that ".join(proof.broken))
    return proof


def _doubt_exposure(brightness: np.ndarray) -> None:
    """Warn where nearly all pixels lie in the first or the last bin of their histogram."""
    shares = brightness / max(brightness.sum(), 1)
    for share, word, remedy in ((shares[0], "black", "more"), (shares[-1], "saturated", "less")):
        if share > EXTREME:
            logger.warning(
                "%.0f %% of what shows is %s; give the light %s intensity", 100 * share, word, remedy
            )


def _doubt_flow(counts: dict[str, list[int]]) -> None:
    """Warn where flow is beyond what C3VD's code can say, with the share that is lost."""
    for name, (flowing, lost) in counts.items():
        if lost:
            logger.warning(
                "%.1f %% of the %s is beyond the ±%g px of its code and lost; %s_exr and %s_npz hold it all",
                *(100 * lost / flowing, name, FLOW_RANGE_PX, name, name),
            )


def _summary(out: Path) -> Summary:
    document = json.loads((out / DATASET).read_text(encoding="utf-8"))
    size = sum(file.stat().st_size for file in out.rglob("*") if file.is_file())
    advice = LAYOUTS[document["format"]].advice
    return Summary(out, document["frames"], size, document["coverage"].get("valid"), advice)


@contextmanager
def _resumable(partial: Partial) -> Iterator[None]:
    """Whatever ends the block: keep what is done and say so, or leave nothing where nothing is done."""
    try:
        yield
    except BaseException as error:
        if not done_shards(partial.path):
            partial.remove()
            if isinstance(error, OSError):
                raise _unwritable(error, partial) from error
            raise
        kept = f"what is done is kept in {partial.path}, and the same command goes on from there"
        if isinstance(error, OSError):
            raise OutputError(f"{_unwritable(error, partial)}; {kept}") from error
        if isinstance(error, EndotwinError):
            raise type(error)(f"{error}; {kept}") from error
        error.add_note(kept)
        raise


def _unwritable(error: OSError, partial: Partial) -> OutputError:
    return unwritable(Path(error.filename or partial.path), error)

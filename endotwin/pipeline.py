"""From a folder to a twin: which frames each stage may use, and what each stage cost."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, replace
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING

from endotwin.config import STANDARD, Config, FitConfig, FuseConfig, load_config
from endotwin.effects import checked_states
from endotwin.errors import OptionError, SequenceError, TwinError
from endotwin.run.arguments import as_path, check_positive, check_progress, check_whole
from endotwin.run.stopwatch import Stopwatch
from endotwin.sequence.readers import open_sequence
from endotwin.twin import Source, Twin, as_twin

if TYPE_CHECKING:
    import numpy as np

    from endotwin.cameras import Camera
    from endotwin.sequence import Sequence
    from endotwin.synth import Limits, Summary

GEOMETRIES = ("known", "heldout")

logger = logging.getLogger("endotwin")

Progress = Callable[[str, int, int], None]


def fuse_twin(
    path: Path | str,
    *,
    format: str | None = None,
    scale: float | None = None,
    geometry: str = "known",
    voxel_mm: float | None = None,
    config: FuseConfig | Config | Path | str = STANDARD.fuse,
    progress: Progress | None = None,
    undistort: tuple[int, int] | None = None,
    without: Iterable[int] | int = (),
) -> Twin:
    """Fuse the depth maps of a sequence into a twin that has a surface and no materials yet.

    Args:
        path: the sequence's folder or ``transforms.json``.
        format: its reader; detected unless given.
        scale: factor on the image size; the config's unless given.
        geometry: ``known`` fuses the depth of every frame (Han & Wu's protocol); ``heldout`` leaves out the
            depth of the held-out frames too. Neither uses their photos.
        voxel_mm: voxel edge; chosen from the depth footprint, times the config's factor, unless given.
        config: how finely to fuse; or the name of a preset, or the file of a config.
        progress: called with (label, done, total).
        undistort: width and height of a pinhole image to resample to first, as published comparisons do.
        without: indices of frames that are left out: neither fused nor fitted nor scored by.

    Raises:
        SequenceError, CameraError: the sequence cannot be used as it is.
        OptionError: an option makes no sense.
    """
    if geometry not in GEOMETRIES:
        raise OptionError(f"geometry {geometry!r} is unknown; choose one of {', '.join(GEOMETRIES)}")
    check_progress(progress)
    config = _whole(config, "fuse").fuse
    scale = check_positive("scale", config.scale if scale is None else scale)
    if voxel_mm is not None:
        voxel_mm = check_positive("voxel size", voxel_mm)
    stopwatch = Stopwatch()
    with stopwatch.stage("open"):
        sequence = open_sequence(path, format=format, scale=scale, undistort=undistort)
    source = Source(
        str(Path(path).resolve()),
        sequence.format,
        scale,
        geometry,
        frames=config.frames,
        split=sequence.split,
        undistort=None if undistort is None else (sequence.camera.width, sequence.camera.height),
    )
    if left_out := _frames(without, sequence):
        source = source.without(left_out, len(sequence))
        sequence = source.limited(sequence)
    training = source.training(len(sequence))
    if not training:
        raise SequenceError(f"{path} has no frame to fit: every one is held out or left out; use more frames")
    heldout = source.heldout(len(sequence)) if geometry == "known" else []
    frames = sorted({*training, *heldout})
    sequence.check_sizes(frames)

    def report(stage: str, done: int, total: int) -> None:
        stopwatch.lap(stage)
        if progress is not None:
            progress(stage, done, total)

    with stopwatch.stage("import"):
        from endotwin import fusion
    choice: dict = {}
    surface = fusion.fuse(sequence, frames, training, voxel_mm, config.voxel, report, choice)
    stopwatch.lap(None)
    if not surface.seen_by.any():
        logger.warning("no training photo of %s shows the mesh: 'endotwin fit' has nothing to fit", path)
    if not source.heldout(len(sequence)):
        logger.warning("no frame of %s is held out: none is left to score the twin by", path)
    made = {
        "frames": len(frames),
        "voxel_mm": voxel_mm,
        "config": asdict(config),
        **choice,
        **stopwatch.to_dict(),
    }
    return Twin(surface, sequence.camera, source, record={"fuse": made})


def align_twin(twin: Twin | Path | str, state: str = "auto", *, progress: Progress | None = None) -> Twin:
    """Align the photos of a twin's sequence to its surface; what was decided stands in ``record["align"]``.

    Args:
        twin: or its folder; what was fitted to it is lost where its photos move.
        state: ``auto``: as far as photos that did not choose the corrections bear them out; ``on``: at least
            what all photos share; ``off``: not at all.
        progress: called with (label, done, total).

    Raises:
        OptionError: another state. SequenceError: the twin's sequence has moved or cannot be read. TwinError:
            polyps were grown on the twin.
    """
    from endotwin.align import align

    check_progress(progress)
    return align(_as_recorded(twin), state, progress)[0]


def fit_twin(
    twin: Twin | Path | str,
    method: str | None = None,
    *,
    budget_s: float | None = None,
    epochs: int | None = None,
    seed: int = 0,
    config: FitConfig | Config | Path | str = STANDARD.fit,
    effects: Mapping[str, str] | None = None,
    align: str | None = None,
    progress: Progress | None = None,
    checkpoint: Path | str | None = None,
    device: str = "cpu",
) -> Twin:
    """Fit materials, light and response to the training photos.

    Args:
        twin: or its folder.
        method: ``twin``, or ``endopbr``: Han & Wu 2025 as published; the config's unless given.
        budget_s: give the best twin of so many seconds; the config's unless given.
        epochs: stop after so many passes over the training photos (``endopbr``).
        seed: of all random choices.
        config: how much work to do; or the name of a preset, or the file of a config.
        effects: auto, on or off by name of the effect (see ``endotwin.effects.NAMES``); the config's unless
            named.
        align: auto, on or off, as of ``align_twin``. Unless given, what was decided about the twin before
            holds, and else auto; but off under a budget, or for ``endopbr``.
        progress: called with (label, done, total).
        checkpoint: file from which a stopped ``endopbr`` goes on; it is removed at the end.
        device: cpu, cuda, or auto for a GPU where there is one.

    Raises:
        OptionError: an option makes no sense. SequenceError: the twin's sequence has moved or cannot be read.
        TwinError: polyps were grown on the twin.
    """
    from endotwin.fit import fit
    from endotwin.render.price import priced

    check_progress(progress)
    if budget_s is not None:
        budget_s = check_positive("budget", budget_s)
    if epochs is not None:
        epochs = check_whole("number of epochs", epochs, 1)
    if checkpoint is not None:
        checkpoint = as_path("checkpoint", checkpoint)
    seed = check_whole("seed", seed)
    settings = _whole(config, "fit")
    effects = {**settings.effects, **checked_states(effects or {})}
    twin = _as_recorded(twin)
    config = replace(
        settings.fit, method=method or settings.fit.method, budget=budget_s or settings.fit.budget
    )
    undecided = "align" not in twin.record and config.method == "twin" and config.budget is None
    if align is not None or undecided:
        twin = align_twin(twin, align or "auto", progress=progress)
    return fit(twin, config, epochs, seed, progress, checkpoint, effects, priced, device)


def _as_recorded(twin: Twin | Path | str) -> Twin:
    """A twin whose surface is what its photos show."""
    twin = as_twin(twin)
    if twin.polyps:
        raise TwinError("polyps were grown on this twin, and its photos show none: take the one without them")
    if twin.fluids:
        raise TwinError("fluids lie on this twin, and its photos show none: take the one without them")
    return twin


def synthesize(
    twin: Twin | Path | str,
    trajectory: str | Path | np.ndarray,
    out: Path | str,
    *,
    material: Iterable[str] | str = (),
    light: Iterable[str] | str = (),
    vary: Path | str | None = None,
    camera: Camera | Path | str | None = None,
    effects: Mapping[str, str] | None = None,
    motion: Iterable[str] | str = (),
    polyps: Iterable[str] | str = (),
    fluids: Iterable[str] | str = (),
    labels: Iterable[str] | str | None = None,
    layout: str = "c3vd",
    limits: Limits | None = None,
    seed: int = 0,
    workers: int = 1,
    scheduler: str | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Summary:
    """Render a labelled dataset from a fitted twin.

    Args:
        twin: or its folder.
        trajectory: a pose file, ``jitter:…``, ``centerline:…``, ``spline:…`` or ``orbit:…`` (see
            ``endotwin.synth.parse_trajectory``), or poses [N, 4, 4], camera to world in mm.
        out: the folder to make. A run that stops leaves ``OUT.partial``, and the same call goes on there.
        material: one edit such as ``roughness*1.3``, or several. light: such as ``intensity*0.8``.
        vary: YAML file of ranges that edits are drawn from (see ``endotwin.synth.read_variation``).
        camera: to render through, or its ``camera.json``; the twin's own unless given.
        effects: on or off by name; noise and lens get the strength that is measured in the twin's sequence,
            or in that whose path stands under the name ``like``.
        motion: of the tissue, such as ``peristalsis:amplitude=1`` or ``breathing``, one or several (see
            ``endotwin.synth.parse_motion``).
        polyps: that grow on the wall, such as ``Is:size=6,count=3`` or ``Ip:size=10``, one or several; places
            that are not given are drawn where the trajectory sees the wall.
        fluids: that lie on it, such as ``blood:size=12`` or ``stool:pool=true``, one or several, at places as
            those of polyps.
        labels: names such as ``rgb,depth`` (see ``endotwin.synth.LABELS``), or ``all``.
        layout: one of ``endotwin.synth.LAYOUTS``.
        limits: what a pose must keep to be rendered.
        seed: of all random choices; the same twin, arguments and seed give the same bytes.
        workers: processes to render in, where 1 is this one; with more, a script needs the guard
            ``if __name__ == "__main__":``. 0: the cores that there are, where that is worth it.
        scheduler: address of a Dask scheduler to render on.
        progress: called with (label, done, total).

    Raises:
        TwinError: the twin is not fitted. TrajectoryError: no trajectory, or one that leaves the lumen.
        OptionError: an edit, label or layout is not understood. OutputError: ``out`` exists, or cannot be
        written.
    """
    from endotwin.synth import Crew, Order, render_dataset

    workers, out = check_whole("number of workers", workers), as_path("dataset", out)
    if scheduler is not None and not isinstance(scheduler, str):
        raise OptionError(f"the scheduler is {scheduler!r}, but must be an address such as tcp://host:8786")
    check_progress(progress)
    varied = (material, light, vary, camera, effects)
    order = Order(trajectory, *varied, motion, polyps, fluids, labels, layout, limits, seed)
    with Crew(1 if scheduler else workers) as crew:
        job = order.job(twin, crew.expected)
        return render_dataset(job, out, workers, scheduler, overwrite, progress, crew.pool)


def with_polyps(
    twin: Twin | Path | str,
    polyps: Iterable[str] | str,
    *,
    trajectory: str | Path | np.ndarray | None = None,
    seed: int = 0,
    limits: Limits | None = None,
) -> Twin:
    """A fitted twin with polyps grown on its wall, which can be rendered, saved and exported as any other.

    Args:
        twin: or its folder.
        polyps: one such as ``Is:size=6,count=3`` (classes Ip, Is, IIa, IIb and IIc of the Paris
            workshop), or several.
        trajectory: that sees the places which are not given, as of ``synthesize``; without one, they are
            anywhere on wall that the training photos show.
        seed: of shapes and places. limits: of the trajectory's poses.

    Raises:
        TwinError: the twin is not fitted. OptionError: a polyp is not understood, or does not fit in.
    """
    from endotwin.synth import with_polyps

    return _with(with_polyps, twin, polyps, trajectory, seed, limits)


def with_fluids(
    twin: Twin | Path | str,
    fluids: Iterable[str] | str,
    *,
    trajectory: str | Path | np.ndarray | None = None,
    seed: int = 0,
    limits: Limits | None = None,
) -> Twin:
    """A fitted twin with fluids on its wall, which can be rendered, saved and exported as any other.

    Args:
        twin: or its folder; polyps grow on it before fluids lie there.
        fluids: one such as ``blood:size=12`` (blood, mucus or stool), or several.
        trajectory: that sees the places which are not given, as of ``synthesize``; without one, they are
            anywhere on wall that the training photos show.
        seed: of shapes and places. limits: of the trajectory's poses.

    Raises:
        TwinError: the twin is not fitted. OptionError: a fluid is not understood, or finds no place.
    """
    from endotwin.synth import with_fluids

    return _with(with_fluids, twin, fluids, trajectory, seed, limits)


def _with(
    added: Callable[..., tuple],
    twin: Twin | Path | str,
    specs: Iterable[str] | str,
    trajectory: str | Path | np.ndarray | None,
    seed: int,
    limits: Limits | None,
) -> Twin:
    """The twin with what ``specs`` ask for ``added``, where the ``trajectory`` sees the wall."""
    from endotwin.synth import parse_trajectory

    seed = check_whole("seed", seed)
    twin, poses = as_twin(twin), None
    if trajectory is not None:
        poses = parse_trajectory(trajectory, twin, seed, twin.camera, limits)
    return added(twin, specs, seed, poses)[0]


def preview(
    twin: Twin | Path | str,
    trajectory: str | Path | np.ndarray,
    out: Path | str,
    *,
    material: Iterable[str] | str = (),
    light: Iterable[str] | str = (),
    vary: Path | str | None = None,
    camera: Camera | Path | str | None = None,
    effects: Mapping[str, str] | None = None,
    motion: Iterable[str] | str = (),
    polyps: Iterable[str] | str = (),
    fluids: Iterable[str] | str = (),
    limits: Limits | None = None,
    seed: int = 0,
    overwrite: bool = False,
) -> str:
    """Draw the poses of a trajectory in the mesh, and some of the frames that ``synthesize`` would render.

    Arguments and errors are those of ``synthesize``; ``out`` is a PNG file. Returns what was written, in a
    line.
    """
    from endotwin.look import preview as draw
    from endotwin.synth import Order

    varied = (material, light, vary, camera, effects)
    order = Order(trajectory, *varied, motion, polyps, fluids, "rgb", limits=limits, seed=seed)
    return draw.preview(order.job(twin), as_path("picture", out), overwrite)


def _whole(config: object, part: str) -> Config:
    """The config of that name or file, or itself where it is one; of a ``part``, ``fuse`` or ``fit``, one
    that is the standard otherwise. Raises OptionError for anything else."""
    if isinstance(config, str | os.PathLike):
        return load_config(config)
    kind = type(getattr(STANDARD, part))
    if isinstance(config, kind):
        return replace(STANDARD, **{part: config})
    if not isinstance(config, Config):
        raise OptionError(
            f"the config is given by its name or file, or as an endotwin.config.{kind.__name__}, and not as "
            f"{type(config).__name__}"
        )
    return config


def _frames(left_out: Iterable[int] | int, sequence: Sequence) -> list[int]:
    """The frames that are left out; raises OptionError where ``sequence`` has no such."""
    try:
        frames = [left_out] if isinstance(left_out, Real) else list(left_out)
    except TypeError:
        raise OptionError(
            f"the frames to leave out are {left_out!r}, but must be indices of frames"
        ) from None
    for index in frames:
        if not isinstance(index, Integral) or not 0 <= index < len(sequence):
            raise OptionError(
                f"{sequence.path} has no frame {index} to leave out: its frames are 0 to {len(sequence) - 1}"
            )
    return frames

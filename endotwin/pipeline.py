"""From a folder to a twin: which frames each stage may use, and what each stage cost."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from pathlib import Path

from endotwin import fusion
from endotwin.errors import OptionError, SequenceError
from endotwin.fit import FitOptions, fit
from endotwin.readers import open_sequence
from endotwin.stopwatch import Stopwatch
from endotwin.synth import Summary, parse_light_edit, parse_material_edit, parse_trajectory
from endotwin.synth.dataset import synthesize as render_dataset
from endotwin.twin import Source, Twin

GEOMETRIES = ("known", "heldout")

Progress = Callable[[str, int, int], None]


def fuse_twin(
    path: Path | str,
    *,
    format: str | None = None,
    scale: float = 1.0,
    geometry: str = "known",
    voxel_mm: float | None = None,
    progress: Progress | None = None,
) -> Twin:
    """Fuse the depth maps of a sequence into a twin that has a surface and no materials yet.

    Args:
        path: the sequence's folder or ``transforms.json``.
        format: its reader; detected unless given.
        scale: factor on the image size.
        geometry: ``known`` fuses the depth of every frame (Han & Wu's protocol); ``heldout`` leaves out the
            depth of the held-out frames too. Neither uses their photos.
        voxel_mm: voxel edge; chosen from the depth footprint unless given.
        progress: called with (label, done, total).

    Raises:
        SequenceError, CameraError: the sequence cannot be used as it is.
        OptionError: an option makes no sense.
    """
    if geometry not in GEOMETRIES:
        raise OptionError(f"geometry {geometry!r} is unknown; choose one of {', '.join(GEOMETRIES)}")
    _check_positive("scale", scale)
    if voxel_mm is not None:
        _check_positive("voxel size", voxel_mm)
    stopwatch = Stopwatch()
    with stopwatch.stage("open"):
        sequence = open_sequence(Path(path), format=format, scale=scale)
    source = Source(str(Path(path).resolve()), sequence.format, scale, geometry)
    training = source.training(len(sequence))
    if not training:
        raise SequenceError(f"{path} has no frame to fit: every one is held out; use more frames")
    frames = range(len(sequence)) if geometry == "known" else training
    with stopwatch.stage("fuse"):
        surface = fusion.fuse(sequence, frames, training, voxel_mm, progress)
    record = {"fuse": {"frames": len(frames), "voxel_mm": voxel_mm, **stopwatch.to_dict()}}
    return Twin(surface, sequence.camera, source, record=record)


def fit_twin(
    twin: Twin,
    method: str = "twin",
    *,
    budget_s: float | None = None,
    epochs: int | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Twin:
    """Fit materials, light and response to the training photos.

    Args:
        method: ``twin``, or ``endopbr``: Han & Wu 2025 as published.
        budget_s: stop after so many seconds. epochs: stop after so many passes over the training photos.
        seed: of all random choices.
        progress: called with (label, done, total).

    Raises:
        OptionError: an option makes no sense. SequenceError: the twin's sequence has moved or cannot be read.
    """
    for name, value in (("budget", budget_s), ("number of epochs", epochs)):
        if value is not None:
            _check_positive(name, value)
    return fit(twin, FitOptions(method=method, budget_s=budget_s, epochs=epochs, seed=seed), progress)


def synthesize(
    twin: Twin,
    trajectory: str,
    out: Path | str,
    *,
    material: Iterable[str] = (),
    light: Iterable[str] = (),
    seed: int = 0,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Summary:
    """Render a labelled dataset from a fitted twin, in C3VD's layout.

    Args:
        trajectory: a pose file, ``jitter:…`` or ``centerline:…`` (see ``endotwin.synth.parse_trajectory``).
        out: the folder to make.
        material: edits such as ``roughness*1.3``. light: edits such as ``intensity*0.8``.
        seed: of all random choices; the same twin, arguments and seed give the same bytes.
        progress: called with (label, done, total).

    Raises:
        TwinError: the twin is not fitted. TrajectoryError: no trajectory, or one that leaves the lumen.
        OptionError: an edit is not understood. OutputError: ``out`` exists, or cannot be written.
    """
    edits = {
        "material_edits": [parse_material_edit(edit) for edit in material],
        "light_edits": [parse_light_edit(edit) for edit in light],
    }
    poses = parse_trajectory(trajectory, twin, seed)
    return render_dataset(twin, poses, out, seed=seed, overwrite=overwrite, progress=progress, **edits)


def _check_positive(name: str, value: float) -> None:
    if not (math.isfinite(value) and value > 0):
        raise OptionError(f"the {name} is {value:g}, but must be greater than 0")

"""A twin and a trajectory become a labelled dataset, which every reader of C3VD reads."""

from __future__ import annotations

import hashlib
import json
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from endotwin.output import check_free, whole_folder
from endotwin.poses import write_c3vd_poses
from endotwin.render import Renderer, View
from endotwin.surface import Surface
from endotwin.synth.edits import Edit, edit_light, edit_materials
from endotwin.synth.layout import (
    CONVENTIONS,
    MASK_NONE,
    MASK_UNSEEN,
    MASK_VALID,
    Labels,
    write_frame,
)
from endotwin.synth.trajectories import Trajectory
from endotwin.twin import Twin

WORKERS = 2
LIBRARIES = ("endotwin", "numpy", "torch", "embreex", "opencv-contrib-python-headless")


@dataclass(frozen=True)
class Summary:
    """What ``synthesize`` wrote.

    Attributes:
        path: the dataset's folder. frames: how many. bytes: size of all of its files.
        valid: share of the pixels that show surface which the training photos show, over all frames.
    """

    path: Path
    frames: int
    bytes: int
    valid: float

    def __str__(self) -> str:
        size = f"{self.bytes / 1e6:.1f} MB"
        return f"{self.path}: {self.frames} frames, {size}, {self.valid:.1%} of the pixels valid"


def synthesize(
    twin: Twin,
    trajectory: Trajectory,
    out: Path | str,
    *,
    seed: int = 0,
    material_edits: Sequence[Edit] = (),
    light_edits: Sequence[Edit] = (),
    overwrite: bool = False,
    progress: Callable[[str, int, int], None] | None = None,
) -> Summary:
    """Render ``trajectory`` with the edited twin and write it in C3VD's layout, whole or not at all.

    The same twin, trajectory, edits and seed give the same bytes on the same machine.

    Args:
        out: folder to make; replaced if it exists and ``overwrite`` is true.
        seed: that the trajectory was drawn with; kept in ``dataset.json``.
        progress: called with (label, done, total).

    Raises:
        TwinError: the twin is not fitted. OutputError: ``out`` exists, or cannot be written.
    """
    out = Path(out)
    check_free(out, overwrite)
    edited = edit_twin(twin, material_edits, light_edits)
    renderer = Renderer(edited, threads=1)
    photographed = photographed_triangles(twin.surface)

    with whole_folder(out, overwrite) as folder:

        def make(index: int) -> float:
            labels = label(renderer.view(trajectory.T_world_camera[index]), photographed)
            write_frame(folder, index, labels)
            return float((labels.mask == MASK_VALID).mean())

        valid = []
        for share in _each(make, len(trajectory)):
            valid.append(share)
            if progress:
                progress("render", len(valid), len(trajectory))
        _write_tables(folder, edited, trajectory)
        document = _document(twin, edited, trajectory, seed, material_edits, light_edits)
        (folder / "dataset.json").write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n")
        size = sum(file.stat().st_size for file in folder.iterdir())
    return Summary(out, len(trajectory), size, float(np.mean(valid)))


def edit_twin(twin: Twin, material_edits: Sequence[Edit], light_edits: Sequence[Edit]) -> Twin:
    """The fitted twin with edited materials and light; an unfitted one as it is."""
    if not twin.fitted:
        return twin
    return replace(
        twin,
        materials=edit_materials(twin.materials, material_edits),
        light=edit_light(twin.light, light_edits),
    )


def photographed_triangles(surface: Surface) -> np.ndarray:
    """Bool [F]: triangles measured, not filled in, and seen by a training frame at every corner."""
    return ((surface.seen_by > 0) & ~surface.filled)[surface.triangles].all(axis=1)


def label(view: View, photographed: np.ndarray) -> Labels:
    """The labels of one view; ``photographed`` is bool [F]."""
    kind = np.where(photographed[view.hits.triangle], np.uint8(MASK_VALID), np.uint8(MASK_UNSEEN))
    return Labels(view.color, view.depth_mm, view.normals, view.image(kind, MASK_NONE))


def _each(make: Callable[[int], float], count: int) -> Iterator[float]:
    """``make(0)``, …, ``make(count - 1)`` in order, on WORKERS threads, with few frames in memory.

    Frames do not depend on each other: each may be made anywhere and at any time.
    """
    with _one_core_a_thread(), ThreadPoolExecutor(WORKERS) as pool:
        running = deque()
        try:
            for index in range(count):
                running.append(pool.submit(make, index))
                if len(running) > WORKERS:
                    yield running.popleft().result()
            while running:
                yield running.popleft().result()
        finally:
            for task in running:
                task.cancel()


@contextmanager
def _one_core_a_thread() -> Iterator[None]:
    """Torch and BLAS keep to the calling thread: with threads of their own, a frame takes 4 times as long."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1, user_api="blas"):
            yield
    finally:
        torch.set_num_threads(before)


def _write_tables(folder: Path, twin: Twin, trajectory: Trajectory) -> None:
    """Poses, timestamps and camera, in digits that read back to the same float64."""
    write_c3vd_poses(folder / "pose.txt", trajectory.T_world_camera)
    timestamps = "".join(f"{float(seconds)!r}\n" for seconds in trajectory.timestamps_s)
    (folder / "timestamps.txt").write_text(timestamps)
    (folder / "camera.json").write_text(json.dumps(twin.camera.to_dict(), indent=1) + "\n")


def _document(
    twin: Twin,
    edited: Twin,
    trajectory: Trajectory,
    seed: int,
    material_edits: Sequence[Edit],
    light_edits: Sequence[Edit],
) -> dict:
    """The content of ``dataset.json``: nothing of it changes from one run to the next of the same command."""
    return {
        "format": "c3vd",
        "frames": len(trajectory),
        "trajectory": trajectory.description,
        "seed": seed,
        "material_edits": [str(edit) for edit in material_edits],
        "light_edits": [str(edit) for edit in light_edits],
        "light": asdict(edited.light),
        "response": asdict(edited.response),
        "twin": {
            "sha256": fingerprint(twin),
            "vertices": len(twin.surface.vertices_mm),
            "sequence": Path(twin.source.path).name,
            "geometry": twin.source.geometry,
        },
        "versions": {library: version(library) for library in LIBRARIES},
        "conventions": CONVENTIONS,
    }


def fingerprint(twin: Twin) -> str:
    """SHA-256 of all that a rendering depends on: mesh, coverage, materials, camera, light and response."""
    digest = hashlib.sha256()
    for part in (twin.surface, twin.camera, twin.materials, twin.light, twin.response):
        for field in fields(part):
            value = np.ascontiguousarray(getattr(part, field.name))
            digest.update(f"{field.name} {value.dtype.str} {value.shape}".encode())
            digest.update(value.tobytes())
    return digest.hexdigest()

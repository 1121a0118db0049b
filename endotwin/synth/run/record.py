"""``dataset.json``: what a dataset was made of, and how to read it. It does not change from run to run."""

from __future__ import annotations

from dataclasses import asdict
from math import isfinite
from pathlib import Path

from endotwin.cameras import Camera
from endotwin.synth.job import fingerprint, versions
from endotwin.synth.labels import LABELS
from endotwin.synth.layouts import LAYOUTS
from endotwin.synth.motion import Motion
from endotwin.synth.trajectories import Trajectory
from endotwin.synth.variation import Variation
from endotwin.twin import Twin

LICENSE_NOTE = (
    "Rendered from a twin of the sequence named under 'twin'. The licence of that sequence covers its "
    "materials and "
    "shape, and so this dataset: check it before you share or sell (C3VD: CC BY-NC-SA 4.0). Endotwin adds "
    "no terms "
    "of its own."
)

COMMON_WORDS = {
    "frames": "frames.jsonl: a JSON object a frame: index, pose (its number in the trajectory that was "
    "asked for), timestamp_s, T_world_camera (4x4, row by row, mm, OpenCV "
    "axes), checks of the pose, the automatic gain if there is one, and the edits that were drawn for it",
    "document": "dataset.json: this; datasheet.html: pictures and histograms",
}


def describe(
    twin: Twin,
    trajectory: Trajectory,
    seed: int,
    labels: tuple[str, ...],
    layout: str,
    camera: Camera,
    variation: Variation,
    motion: Motion | None = None,
    recorder: bool = False,
) -> dict:
    """All of ``dataset.json`` that is known before the first frame is rendered.

    ``recorder``: whether frames are recorded as a video.
    """
    chosen = LAYOUTS[layout]
    moving = {} if motion is None else {"motion": motion.to_dict()}
    standing = {"polyps": _table(twin)} if twin.polyps else {}
    if twin.fluids:
        standing["fluids"] = [{"number": k, **asdict(fluid)} for k, fluid in enumerate(twin.fluids, 1)]
    words = {image: chosen.encoding(image).words for label in labels for image in LABELS[label]}
    return {
        "format": layout,
        "frames": len(trajectory),
        "labels": list(labels),
        "trajectory": trajectory.description,
        "poses": trajectory.counts,
        "limits": _finite(asdict(trajectory.limits)) if trajectory.limits else {},
        "seed": seed,
        "command": {
            "trajectory": trajectory.spec,
            "layout": layout,
            "labels": ",".join(labels),
            "seed": seed,
        },
        "variation": variation.to_dict(),
        **moving,
        **standing,
        "camera": camera.to_dict(),
        "twin": {
            "sha256": fingerprint(twin),
            "vertices": len(twin.surface.vertices_mm),
            "sequence": Path(twin.source.path).name,
            "geometry": twin.source.geometry,
            "camera": twin.camera.to_dict(),
            "light": asdict(twin.light),
            "response": asdict(twin.response),
            "effects": twin.effects.to_dict(),
        },
        "versions": versions(recorder),
        "conventions": {**words, **chosen.words, **COMMON_WORDS},
        "license_note": LICENSE_NOTE,
    }


def _table(twin: Twin) -> list[dict]:
    """The polyps by number, as the label has it."""
    return [
        {"number": number, "paris": f"0-{polyp.kind}", **asdict(polyp)}
        for number, polyp in enumerate(twin.polyps, 1)
    ]


def _finite(values: dict[str, float]) -> dict[str, float | None]:
    """Values that JSON has: null for no limit."""
    return {name: value if isfinite(value) else None for name, value in values.items()}

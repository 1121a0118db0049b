"""What the labels of two frames that follow each other claim of one another."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from endotwin.synth.proof.warp import Frame, Landing, Sampled, landing, sampled
from endotwin.synth.proof.within import FLOWS, Judged
from endotwin.synth.sight import OCCLUSION_RANGE_MM

SEEN, HIDDEN = 0, 255
BEHIND_MM = 0.5
"""Surface that lies so far behind another, and 1 % of its distance, is not the same."""

SLOPE = 0.25
"""Share of what four pixels differ by, by which what lies between them is off their interpolation."""

MATERIALS = ("albedo", "roughness", "metallic")


def between(one: Frame, other: Frame) -> Iterator[Judged]:
    """All claims of ``one`` on ``other``, a neighbour of it."""
    name = "flow_forward" if other.index > one.index else "flow"
    written = one.written
    flow_px = one.first(*FLOWS[name])
    back_px = other.first(*FLOWS["flow" if name == "flow_forward" else "flow_forward"])
    moved = one.first(f"scene_{name}")
    if one.distance_mm is not None and not (written.moving and moved is None):
        there = landing(one, other, moved)
        for image in filter(written.has, FLOWS[name]):
            yield "flow", _flow(one.image(image), there, written.step(image))
        hidden = one.first(f"{name}_hidden")
        yield from _depths(other, there, None if hidden is None else hidden.ravel()[there.chosen])
        yield from _materials(one, other, there)
        for label in filter(written.has, ("polyp", "fluid")):
            yield f"{label}s", _numbers(label, one, other, there)
    if flow_px is not None and back_px is not None and other.distance_mm is not None:
        yield "cycle", _cycle(one, other, name, flow_px, back_px)


def _flow(flow_px: np.ndarray, there: Landing, step_px: float) -> np.ndarray:
    """Difference, px, between the label and what depth and poses give."""
    label = flow_px.reshape(-1, 2)[there.chosen]
    off = np.linalg.norm(label - there.flow(flow_px.shape[1]), axis=1) - there.slack_px - step_px
    return np.maximum(off[np.isfinite(off)], 0)


def _depths(other: Frame, there: Landing, hidden: np.ndarray | None) -> Iterator[Judged]:
    """Whether points lie on or behind what the other frame sees in their place."""
    about = sampled(other, there.uv)
    about = about.where(np.isfinite(about.values(other.distance_mm)).all(axis=1))
    four, distance_mm = about.values(other.distance_mm), there.distance_mm[about.chosen]
    nearest, farthest = four.min(axis=1), four.max(axis=1)
    lies_mm = 1 / np.einsum("mk,mk->m", about.weights, 1 / four)
    slack_mm = there.slack_mm[about.chosen] + other.half_step_mm(about.four[:, 0])
    off_mm = np.abs(distance_mm - lies_mm) - slack_mm - SLOPE * (farthest - nearest)
    smooth = about.values(other.smooth).all(axis=1)
    seen = smooth & (distance_mm < farthest + BEHIND_MM)
    if hidden is not None:
        hidden = hidden[about.chosen] == HIDDEN
        seen = smooth & ~hidden
        behind = distance_mm > farthest + slack_mm + BEHIND_MM
        even = smooth & (farthest - nearest < BEHIND_MM)
        wrong = np.where(hidden, even & (off_mm < 0), behind)
        yield "hidden", wrong[hidden | behind].astype(float)
    yield "warp", 100 * (np.maximum(off_mm, 0) / lies_mm)[seen]
    if other.written.has("occlusion"):
        behind = (distance_mm > 1.01 * farthest + BEHIND_MM) & (distance_mm < OCCLUSION_RANGE_MM)
        yield "occlusion", (about.values(other.image("occlusion")) == 0).all(axis=1)[behind].astype(float)


def _same_tissue(other: Frame, there: Landing) -> Sampled:
    """Where points land on smooth surface of the other frame, and on it."""
    about = sampled(other, there.uv)
    about = about.where(about.values(other.smooth).all(axis=1))
    lies = np.abs(about.mean(other.distance_mm) - there.distance_mm[about.chosen]) < BEHIND_MM / 5
    return about.where(lies)


def _numbers(label: str, one: Frame, other: Frame, there: Landing) -> np.ndarray:
    """Whether what has a number of the ``label`` has another there, or none, where all about it has one."""
    about = _same_tissue(other, there)
    four = about.values(other.image(label))
    here = one.image(label).ravel()[there.chosen[about.chosen]]
    told = (four == four[:, :1]).all(axis=1) & ((four[:, 0] > 0) | (here > 0))
    return (four[:, 0] != here)[told].astype(float)


def _materials(one: Frame, other: Frame, there: Landing) -> Iterator[Judged]:
    """Whether the tissue has the materials there that it has here."""
    same = ("material", "regions")
    here_drawn, there_drawn = (each.written.records[each.index] for each in (one, other))
    if any(here_drawn.get(key) != there_drawn.get(key) for key in same):
        return
    about = _same_tissue(other, there)
    for name in filter(one.written.has, MATERIALS):
        here = one.image(name).reshape(len(one.distance_mm.ravel()), -1)[there.chosen[about.chosen]]
        there_too = other.image(name).reshape(*other.distance_mm.shape, -1)
        off = np.abs(about.mean(there_too) - here) - SLOPE * np.ptp(about.values(there_too), axis=1)
        yield "materials", np.maximum(off, 0).max(axis=1)


def _cycle(one: Frame, other: Frame, name: str, flow_px: np.ndarray, back_px: np.ndarray) -> np.ndarray:
    """How far from their pixels, px, flow to the other frame and back from there leads."""
    chosen = np.flatnonzero((one.image(f"{name}_hidden") == SEEN) & np.isfinite(flow_px).all(axis=-1))
    out = flow_px.reshape(-1, 2)[chosen]
    uv = np.stack([chosen % flow_px.shape[1], chosen // flow_px.shape[1]], axis=1) + out
    about = sampled(other, uv)
    about = about.where(about.values(other.smooth).all(axis=1))
    back, differ = about.mean(back_px), np.ptp(about.values(back_px), axis=1)
    off = np.linalg.norm(out[about.chosen] + back, axis=1) - SLOPE * np.linalg.norm(differ, axis=1)
    return np.maximum(off[np.isfinite(off)], 0)

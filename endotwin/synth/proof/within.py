"""What the labels of one frame claim of each other."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
import torch

from endotwin.effects import RENDERED
from endotwin.effects.tone import Tone
from endotwin.surface.vectors import dot, unit
from endotwin.synth.photograph import RECORDING
from endotwin.synth.proof.warp import DEPTHS, Frame
from endotwin.twin.fluids import covered
from endotwin.twin.polyps import numbered

Judged = tuple[str, np.ndarray]
"""The name of a claim, and the errors of the pixels that were judged by it."""

WINDOW, WHOLE = 17, 0.9
"""Pixels a side over which normals and gradients of depth are averaged, since normals are smooth over a mesh
whose facets are flat; and the share of them that must be judged."""

EVEN = np.cos(np.radians(5))
"""Length of the mean of unit normals, where they spread by no more than 5°: a mesh tells the normal of
a fold that its triangles hardly follow in more than one way."""

GRAZING = 0.2
"""Least cosine between normal and ray where the gradient of depth is judged."""

HIGHLIGHT_MARGIN = 1.5 / 255
FLOWS = {
    "flow": ("flow_npz", "flow_exr", "flow"),
    "flow_forward": ("flow_forward_npz", "flow_forward_exr", "flow_forward"),
}
"""Images of the flow to the previous and to the next frame, the most precise first."""


def within(frame: Frame) -> Iterator[Judged]:
    """All claims on one frame."""
    yield from _places(frame)
    yield from _codes(frame)
    if frame.written.has("normals") and frame.distance_mm is not None:
        yield "normals", _normals(frame)
    placed = not frame.written.moving or frame.written.has("vertices")
    if frame.written.has("triangles") and frame.distance_mm is not None and placed:
        yield "triangles", _triangles(frame)
    for name, numbers in (("polyp", _polyps), ("fluid", _fluids)):
        if frame.written.has("triangles", name):
            told, triangle = frame.image(name), frame.image("triangles")
            named = np.where(triangle >= 0, numbers(frame)[triangle], 0)
            yield f"{name}s", (told != named)[(told > 0) | (named > 0)].astype(float)
    yield from _colors(frame)


def _there(frame: Frame) -> np.ndarray | None:
    """Bool [H, W]: pixels with surface, as the label says that tells it most directly."""
    says = {"mask": lambda x: x > 0, "triangles": lambda x: x >= 0, "normals": lambda x: x.any(axis=-1)}
    for name, of in says.items():
        if frame.written.has(name):
            return of(frame.image(name))
    return None if frame.distance_mm is None else ~np.isnan(frame.first(*DEPTHS))


def _places(frame: Frame) -> Iterator[Judged]:
    """Where labels have values."""
    there, has = _there(frame), frame.written.has
    if there is None:
        return
    behind = frame.written.rays[..., 2] <= 0
    wrong = np.zeros(there.shape, bool)
    for name, told in (
        ("mask", lambda x: x > 0),
        ("triangles", lambda x: x >= 0),
        ("normals", lambda x: x.any(axis=-1)),
        ("depth_exr", np.isfinite),
    ):
        if has(name):
            wrong |= told(frame.image(name)) != there
    if has("depth"):
        wrong |= (~np.isnan(frame.image("depth")) != there) & ~behind
    for name, told in (
        ("albedo", lambda x: x.any(axis=-1)),
        ("roughness", np.bool_),
        ("occlusion", np.bool_),
        ("polyp", np.bool_),
        ("fluid", np.bool_),
    ):
        if has(name):
            wrong |= told(frame.image(name)) & ~there
    for name, other in (("flow", frame.index - 1), ("flow_forward", frame.index + 1)):
        exists = 0 <= other < len(frame.written)
        for image in filter(has, FLOWS[name]):
            wrong |= np.isfinite(frame.image(image)).all(axis=-1) & ~(there & exists)
        if has(f"scene_{name}"):
            wrong |= np.isfinite(frame.image(f"scene_{name}")).all(axis=-1) != (there & exists)
        if has(f"{name}_hidden"):
            wrong |= (frame.image(f"{name}_hidden") == 128) == (there & exists)
    yield "places", wrong.ravel().astype(float)


def _codes(frame: Frame) -> Iterator[Judged]:
    """Labels that are written in several ways."""
    for names in (("depth_exr", "depth"), *FLOWS.values(), ("rgb_exr", "rgb_linear")):
        finest, *others = [name for name in names if frame.written.has(name)] or [None]
        for name in others:
            fine, coarse = frame.image(finest), frame.image(name)
            if name == "rgb_linear":
                fine = np.clip(fine, 0, 1)
            judged = np.isfinite(fine) & np.isfinite(coarse)
            if name == "depth":
                judged &= fine > frame.written.step(name)
            half = frame.written.step(name) / 2 + 2**-11 * np.abs(fine) * (name == "rgb_linear")
            if frame.written.step(name):
                yield "codes", (np.abs(fine - coarse) / half)[judged]
            else:
                yield "codes", np.where(fine == coarse, 0.0, 2.0)[judged]


def _normals(frame: Frame) -> np.ndarray:
    """Angles, degrees, between normals and the gradient of depth, each averaged over WINDOW."""
    points = frame.written.rays * frame.distance_mm[..., None]
    across, down = (points[1:-1, 2:] - points[1:-1, :-2]), (points[2:, 1:-1] - points[:-2, 1:-1])
    told, rays = frame.image("normals")[1:-1, 1:-1], frame.written.rays[1:-1, 1:-1]
    by_depth = unit(np.cross(down, across))
    judged = cv2.erode(frame.smooth.astype(np.uint8), np.ones((3, 3), np.uint8))[1:-1, 1:-1] > 0
    judged &= (dot(by_depth, rays) < -GRAZING) & (dot(told, told) > 0.5)
    means = [_window_mean(np.where(judged[..., None], n, 0)) for n in (by_depth, told)]
    share = _window_mean(judged.astype(float))
    even = (share > WHOLE) & (dot(means[0], means[0]) > (EVEN * share) ** 2)
    one, other = (unit(mean[even]) for mean in means)
    apart = one - other
    return np.degrees(2 * np.arcsin(np.minimum(np.sqrt(dot(apart, apart)) / 2, 1)))


def _window_mean(image: np.ndarray) -> np.ndarray:
    """Means over windows [h, w, ...] of an image [H, W, ...], half a window apart."""
    half = WINDOW // 2
    return cv2.boxFilter(image, -1, (WINDOW, WINDOW), borderType=cv2.BORDER_CONSTANT)[::half, ::half]


def _triangles(frame: Frame) -> np.ndarray:
    """Distance, mm, of the pixels' points from the planes of their triangles."""
    chosen = np.flatnonzero(np.isfinite(frame.distance_mm) & (frame.image("triangles") >= 0))
    rays = frame.written.rays.reshape(-1, 3)[chosen] @ frame.T_world_camera[:3, :3].T
    points = frame.T_world_camera[:3, 3] + rays * frame.distance_mm.ravel()[chosen, None]
    vertices_mm, triangles = frame.written.surface
    if frame.written.moving:
        vertices_mm = frame.image("vertices")
    a, b, c = vertices_mm[triangles[frame.image("triangles").ravel()[chosen]]].transpose(1, 0, 2)
    facing = unit(np.cross(b - a, c - a))
    off = np.abs(dot(points - a, facing)) - frame.half_step_mm(chosen) * np.abs(dot(rays, facing))
    return np.maximum(off, 0)


def _polyps(frame: Frame) -> np.ndarray:
    """Numbers [F] of the polyps to which ``dataset.json`` counts the triangles."""
    polyps = frame.written.document["polyps"]
    return numbered((each["triangles"] for each in polyps), len(frame.written.surface[1]))


def _fluids(frame: Frame) -> np.ndarray:
    """Numbers [F] of the fluids to which ``dataset.json`` counts the triangles."""
    fluids = frame.written.document["fluids"]
    return covered((each["triangles"] for each in fluids), len(frame.written.surface[1]))


def _colors(frame: Frame) -> Iterator[Judged]:
    """What the images of light claim, where nothing that depends on chance or on the optics lies between."""
    record, has = frame.written.records[frame.index], frame.written.has
    switched = record.get("effects", {})
    effects = set(frame.written.document["twin"]["effects"]) | set(switched)
    rendered = {name for name in effects & set(RENDERED) if switched.get(name) != "off"}
    if has("rgb", "diffuse", "specular") and not rendered:
        together = frame.image("diffuse") + frame.image("specular")
        yield "split", 255 * np.abs(frame.image("rgb") - together).ravel()
    if has("specular", "highlights"):
        least = frame.image("specular").min(axis=2)
        clear = np.abs(least - 0.1) > HIGHLIGHT_MARGIN
        yield "places", ((least > 0.1) != (frame.image("highlights") > 0))[clear].astype(float)
    linear = frame.first("rgb_exr", "rgb_linear")
    if (
        linear is not None
        and has("rgb")
        and not rendered & {"noise", *RECORDING}
        and not record.get("response")
        and not ("tone" in switched or any(edit.startswith("tone.") for edit in record.get("parameters", ())))
    ):
        twin = frame.written.document["twin"]
        lit = (linear > 1e-3) & (linear < 1)
        shown = torch.from_numpy(np.clip(linear, 0, 1) ** twin["response"]["gamma"])
        if "tone" in twin["effects"]:
            shown = Tone(**twin["effects"]["tone"]).shown(shown)
        yield "response", 255 * np.abs(shown.numpy() - frame.image("rgb"))[lit]

"""The method ``endopbr``: Han & Wu 2025 as published, to compare with.

A hash grid and a small MLP are queried at each pixel's point; light, response and field are learned
together by Adam from pixels of a few images a step, with normals from the gradient of the depth map, or of
the surface where photos were aligned apart from their depth maps. When done, the field is sampled at the
vertices, so that the twin renders like any other.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from endotwin.errors import SequenceError
from endotwin.fit.checkpoint import Checkpoint, identity
from endotwin.fit.hashgrid import level_slots
from endotwin.light import shading
from endotwin.light.forward import Lit, Lobes, radiance
from endotwin.light.incidence import COS_MIN
from endotwin.pixels.samples import frame_samples
from endotwin.pixels.start import ALBEDO_TOP
from endotwin.run.ahead import ahead
from endotwin.run.stopwatch import Stopwatch
from endotwin.sequence import Frame, Sequence
from endotwin.surface.casting import Caster
from endotwin.surface.vectors import unit
from endotwin.twin import Light, Materials, Response, Twin

LEVELS, FEATURES, LOG2_SLOTS = 16, 2, 19
COARSEST_CELLS, FINEST_CELLS = 16, 2048
"""Cells along the scene's longest side at the first and the last level (Müller et al. 2022, table 1)."""

CPU = torch.device("cpu")
ROOM = 0.5
"""Share of a GPU's free memory in which photos are kept."""

LOBES = Lobes(shading.F0_DIELECTRIC, burley=False)

MARGIN = 0.01
"""The grid reaches this part of the scene's longest side beyond the surface."""

HIDDEN = 64
IMAGES_A_STEP, PIXELS_A_STEP = 5, 30_000
DEFAULT_EPOCHS = 100
LEARNING_RATE = 1e-2
METALLIC_WEIGHT, GRADIENT_WEIGHT = 1e-4, 1e-3
BAKE_CHUNK = 1 << 16
BAKE_SHARE = 0.6
"""Time that a vertex takes to bake, in shares of a training pixel's: a budget leaves that much."""


class Field(nn.Module):
    """Base colour, roughness and metallic of points: hash grid and a 2×64 MLP.

    Args:
        low_mm, high_mm: float64 [3], the box of the scene.
    """

    def __init__(self, low_mm: np.ndarray, high_mm: np.ndarray):
        super().__init__()
        self.register_buffer("low_mm", torch.from_numpy(low_mm))
        longest_mm = float((high_mm - low_mm).max())
        growth = (FINEST_CELLS / COARSEST_CELLS) ** (1 / (LEVELS - 1))
        self.cells_mm = longest_mm / COARSEST_CELLS / growth ** np.arange(LEVELS)
        self.table = nn.Parameter(torch.empty(LEVELS << LOG2_SLOTS, FEATURES).uniform_(-1e-4, 1e-4))
        self.decoder = nn.Sequential(
            nn.Linear(LEVELS * FEATURES, HIDDEN),
            nn.ReLU(),
            nn.Linear(HIDDEN, HIDDEN),
            nn.ReLU(),
            nn.Linear(HIDDEN, 5),
        )

    def forward(self, points_mm: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Base colour [N, 3], roughness [N], metallic [N] at points float64 [N, 3], local frame."""
        slots, weights = level_slots(points_mm - self.low_mm, self.cells_mm, LOG2_SLOTS)
        features = nn.functional.embedding_bag(
            slots.reshape(-1, 8), self.table, per_sample_weights=weights.reshape(-1, 8), mode="sum"
        )
        decoded = torch.sigmoid(self.decoder(features.reshape(len(points_mm), -1)))
        return decoded[:, :3], decoded[:, 3], decoded[:, 4]


class SharedParameters(nn.Module):
    """L0, n, q and γ, kept positive by exponentials."""

    def __init__(self, distance_mm: float):
        super().__init__()
        start = [2 * math.log(distance_mm), 0.0, math.log(2.0), math.log(1 / 2.2)]
        self.logs = nn.Parameter(torch.tensor(start))

    @property
    def light(self) -> Light:
        log_L0, log_n, log_q, _ = self.logs.tolist()
        return Light(math.exp(log_L0), math.exp(log_n), math.exp(log_q))

    @property
    def response(self) -> Response:
        return Response(math.exp(self.logs[3].item()))


def photo_geometry(twin: Twin, frame: Frame, lens_mask: np.ndarray) -> dict[str, np.ndarray]:
    """Points, incidence and colours of one photo's pixels, normals from the gradient of its depth map.

    Returns:
        points_mm [N, 3] in the surface's local frame; cos, sin2, log_cos_axis, log_distance [N]; color uint8
        [N, 3].
    """
    rays = twin.camera.pixel_directions
    points = rays * (frame.depth_mm / np.where(rays[..., 2] > COS_MIN, rays[..., 2], np.nan))[..., None]
    across = np.gradient(points, axis=1)
    down = np.gradient(points, axis=0)
    normal = unit(np.cross(down, across))
    to_eye = -rays
    cos = np.einsum("hwk,hwk->hw", normal, to_eye)
    use = lens_mask & np.isfinite(frame.depth_mm) & (np.abs(cos) > COS_MIN)
    normal, cos, to_eye, points = normal[use], cos[use], to_eye[use], points[use].astype(np.float64)
    normal, cos = normal * np.sign(cos)[:, None], np.abs(cos)
    tangential = normal - cos[:, None] * to_eye
    T_local_camera = twin.surface.to_local(frame.T_world_camera)
    return {
        "points_mm": points @ T_local_camera[:3, :3].T + T_local_camera[:3, 3],
        "cos": cos,
        "sin2": np.einsum("nk,nk->n", tangential, tangential),
        "log_cos_axis": np.log(np.maximum(rays[..., 2][use], COS_MIN)),
        "log_distance": np.log(np.linalg.norm(points, axis=1)).astype(np.float32),
        "color": frame.color[use],
    }


def surface_geometry(
    caster: Caster, twin: Twin, frame: Frame, lens_mask: np.ndarray
) -> dict[str, np.ndarray]:
    """What ``photo_geometry`` returns, where rays meet the surface: of a photo that lies apart from its depth
    map."""
    seen = frame_samples(twin, caster, frame, lens_mask, 1.0, np.random.default_rng(0))
    corners_mm = twin.surface.vertices_mm.astype(np.float64)[twin.surface.triangles[seen.triangle.numpy()]]
    names = ("cos", "sin2", "log_cos_axis", "log_distance", "color")
    return {
        "points_mm": np.einsum("nk,nka->na", seen.barycentric.numpy(), corners_mm),
        **{name: getattr(seen, name).numpy() for name in names},
    }


class Photos:
    """The geometry of photos on a device, of which a GPU keeps as many as ROOM of its free memory holds."""

    def __init__(self, twin: Twin, sequence: Sequence, device: torch.device):
        self._twin, self._sequence, self._device = twin, sequence, device
        self._caster = None if twin.depth_at_photos else Caster(twin.surface)
        self._kept: dict[int, dict[str, Tensor]] = {}
        self._left = ROOM * torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else 0

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        """``photo_geometry``, or ``surface_geometry``, of frame ``index``."""
        if index in self._kept:
            return self._kept[index]
        frame = self._sequence.frame(index)
        shown = photo_geometry if self._caster is None else partial(surface_geometry, self._caster)
        values = shown(self._twin, frame, self._sequence.lens_mask)
        found = {name: torch.from_numpy(value).to(self._device) for name, value in values.items()}
        self._left -= sum(value.nbytes for value in found.values())
        if self._left >= 0:
            self._kept[index] = found
        return found


def fit_endopbr(
    twin: Twin,
    budget_s: float | None,
    epochs: int | None,
    seed: int,
    progress: Callable[[str, int, int], None] | None = None,
    checkpoint: Path | None = None,
    device: torch.device = CPU,
) -> Twin:
    """Train for ``epochs`` passes over the training images, or until ``budget_s`` seconds are up, whichever
    is first.

    A training that was stopped goes on from the file ``checkpoint``, which is removed at the end. The twin is
    that of a training that was not stopped, bit for bit on one machine without a GPU. All training is done on
    ``device``; a GPU keeps the photos too, as many as it has memory for.

    Raises:
        SequenceError: the training photos show nothing of the surface.
    """
    stopwatch = Stopwatch()
    seen = twin.surface.seen_by > 0
    if not seen.any():
        raise SequenceError(
            f"the training photos of {twin.source.path} show nothing of the surface; "
            "check that poses and depth fit it"
        )
    torch.manual_seed(seed)
    vertices = twin.surface.vertices_mm.astype(np.float64)
    low_mm, high_mm = vertices.min(axis=0), vertices.max(axis=0)
    margin_mm = MARGIN * (high_mm - low_mm).max()
    field = Field(low_mm - margin_mm, high_mm + margin_mm).to(device)
    shared = SharedParameters(float(np.median(twin.surface.nearest_mm[seen]))).to(device)
    optimizer = torch.optim.Adam([*field.parameters(), *shared.parameters()], lr=LEARNING_RATE, eps=1e-15)
    sequence = twin.sequence()
    frames = twin.source.training(len(sequence))
    per_epoch = math.ceil(len(frames) / IMAGES_A_STEP)
    steps = per_epoch * (epochs or (10**6 if budget_s else DEFAULT_EPOCHS))
    kept = Checkpoint(checkpoint, identity(twin, seed, LOG2_SLOTS, PIXELS_A_STEP, LEARNING_RATE), optimizer)
    first, spent = kept.resume(steps)
    done, started = first, time.perf_counter() - spent

    photos = Photos(twin, sequence, device)

    def batch(step: int) -> dict[str, Tensor] | None:
        """Pixels of the images that are due; None where those have no depth."""
        epoch, turn = divmod(step, per_epoch)
        order = np.random.default_rng((seed, epoch)).permutation(len(frames))
        chosen = order[turn * IMAGES_A_STEP : (turn + 1) * IMAGES_A_STEP]
        parts = [photos[frames[index]] for index in chosen]
        joined = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
        if not len(joined["cos"]):
            return None
        picked = np.random.default_rng((seed, epoch, turn)).integers(0, len(joined["cos"]), PIXELS_A_STEP)
        picked = torch.from_numpy(picked).to(device)
        return {name: values[picked] for name, values in joined.items()}

    batches = ahead(batch, range(first, steps))
    with stopwatch.stage("train"), kept.told_when_stopped(), closing(batches):
        for done, pixels in enumerate(batches, first + 1):
            if pixels is not None:
                _step(field, shared, optimizer, pixels)
            if progress:
                progress(f"train, resumed at step {first}" if first else "train", done, steps)
            elapsed_s = time.perf_counter() - started
            bake_s = BAKE_SHARE * len(vertices) / PIXELS_A_STEP * elapsed_s / done
            if budget_s is not None and elapsed_s + bake_s >= budget_s:
                break
            kept.keep(done, time.perf_counter() - started)
    with stopwatch.stage("bake"):
        materials, light = _baked(field, shared, twin)
    kept.remove()
    record = {"method": "endopbr", "steps": done, "epochs": done / per_epoch, **stopwatch.to_dict()}
    return replace(twin, materials=materials, light=light, response=shared.response).with_record(fit=record)


def _step(field: Field, shared: SharedParameters, optimizer: torch.optim.Optimizer, pixels: dict) -> None:
    optimizer.zero_grad(set_to_none=True)
    base_color, roughness, metallic = field(pixels["points_mm"])
    error = (_predict(pixels, base_color, roughness, metallic, shared) - pixels["color"] / 255).abs()
    few = slice(0, PIXELS_A_STEP // 8)
    step_mm = field.cells_mm[-1]
    aside = torch.from_numpy(unit(np.random.default_rng(0).normal(size=(PIXELS_A_STEP // 8, 3))))
    beside = pixels["points_mm"][few] + step_mm * aside.to(base_color.device)
    gradient = (field(beside)[0] - base_color[few]).abs().mean() / step_mm
    loss = error.mean() + METALLIC_WEIGHT * metallic.abs().mean() + GRADIENT_WEIGHT * gradient
    loss.backward()
    optimizer.step()


def _predict(
    pixels: dict, base_color: Tensor, roughness: Tensor, metallic: Tensor, shared: SharedParameters
) -> Tensor:
    """C = (f·L·(n·ω)·2π)^γ (Han & Wu 2025), [N, 3]."""
    cos, sin2, log_cos_axis, log_distance = (
        pixels[name] for name in ("cos", "sin2", "log_cos_axis", "log_distance")
    )
    log_L0, log_n, log_q, log_gamma = shared.logs
    lit = Lit.at_lens(cos, sin2, log_cos_axis, log_distance)
    diffuse = base_color * (1 - metallic)[:, None]
    x = radiance(lit, (log_L0, log_n.exp(), log_q.exp()), diffuse, roughness, LOBES)
    return shading.respond(x, log_gamma.exp())


def _baked(field: Field, shared: SharedParameters, twin: Twin) -> tuple[Materials, Light]:
    """Materials at the vertices, with the scale that light and albedo share fixed as for the method
    ``twin``.
    """
    parts = []
    with torch.no_grad():
        for start in range(0, len(twin.surface.vertices_mm), BAKE_CHUNK):
            points_mm = torch.from_numpy(twin.surface.vertices_mm[start : start + BAKE_CHUNK]).double()
            color, roughness, metallic = field(points_mm.to(shared.logs.device))
            parts.append(torch.cat([color, roughness[:, None], metallic[:, None]], dim=1))
    values = torch.cat(parts).cpu().numpy()
    seen = twin.surface.seen_by > 0
    scale = float(ALBEDO_TOP / np.percentile(values[seen if seen.any() else slice(None), :3].max(axis=1), 98))
    light = shared.light
    materials = Materials(
        base_color=np.clip(values[:, :3] * scale, 0, 1),
        roughness=np.ascontiguousarray(values[:, 3]),
        metallic=np.ascontiguousarray(values[:, 4]),
        f0=shading.F0_DIELECTRIC * scale,
        diffuse="lambert",
    )
    return materials, Light(light.L0 / scale, light.n, light.q)

"""A fitted twin of a bent tube whose axis, wall and normals are known in closed form."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from endotwin.cameras import Camera, Pinhole
from endotwin.effects import Effects
from endotwin.fit.gauss_newton import GaussNewton
from endotwin.fit.hashgrid import HashOperator
from endotwin.fit.lighting import Relighting, lit
from endotwin.fit.model import Globals, at_pixels, predict
from endotwin.fit.state import State, roughness_to_raw
from endotwin.light.incidence import incidence
from endotwin.pixels.samples import Samples, Views
from endotwin.render import Renderer
from endotwin.surface import Surface
from endotwin.surface.casting import Caster
from endotwin.twin import Light, Materials, Response, Source, Twin

RADIUS_MM, BEND_MM, SWEEP = 12.0, 60.0, np.pi / 2
CAMERA = Pinhole(96, 72, 58.0, 58.0, 47.5, 35.5)


def axis(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points [N, 3] and unit tangents [N, 3] of the axis, a quarter circle in the xz plane, at s [N]."""
    points = BEND_MM * np.stack([1 - np.cos(s), np.zeros_like(s), np.sin(s)], axis=-1)
    return points, np.stack([np.sin(s), np.zeros_like(s), np.cos(s)], axis=-1)


def to_axis(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angle s [N] and vector [N, 3] from points [N, 3] to the nearest point of the axis."""
    s = np.arctan2(points[..., 2], BEND_MM - points[..., 0])
    return s, axis(s)[0] - points


def pose(s: float) -> np.ndarray:
    """The pose [4, 4] on the axis at angle s, looking along it, y as in the world."""
    point, ahead = axis(np.array(s))
    T_world_camera = np.eye(4)
    T_world_camera[:3] = np.stack([np.cross([0, 1.0, 0], ahead), [0, 1.0, 0], ahead, point], axis=1)
    return T_world_camera


def surface(fold_mm: float = 0.0, holes: int = 0) -> Surface:
    """The open tube, with ring-like folds of uneven height every 8.3 mm and round holes of 3 mm radius."""
    along, around = 220, 120
    s, angle = np.meshgrid(
        np.linspace(0, SWEEP, along), np.arange(around) * 2 * np.pi / around, indexing="ij"
    )
    centre, tangent = axis(s)
    side = np.cross(tangent, [0, 1.0, 0])
    outward = np.cos(angle)[..., None] * side + np.sin(angle)[..., None] * [0, 1.0, 0]
    fold = (
        fold_mm * np.maximum(np.cos(s * BEND_MM / 8.3 * 2 * np.pi), 0) ** 4 * (0.6 + 0.4 * np.cos(3 * angle))
    )
    vertices = (centre + (RADIUS_MM - fold)[..., None] * outward).reshape(-1, 3)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(along - 1), np.arange(around), indexing="ij"))
    a, b = i * around + j, i * around + (j + 1) % around
    triangles = np.concatenate([np.stack([a, b, a + around], 1), np.stack([b, b + around, a + around], 1)])
    normals = np.zeros_like(vertices)
    facing = np.cross(
        vertices[triangles[:, 1]] - vertices[triangles[:, 0]],
        vertices[triangles[:, 2]] - vertices[triangles[:, 0]],
    )
    for corner in range(3):
        np.add.at(normals, triangles[:, corner], facing)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    middles = vertices[triangles].mean(axis=1)
    for hole in vertices[np.random.default_rng(0).choice(len(vertices), holes)]:
        far = np.linalg.norm(middles - hole, axis=1) > 3
        triangles, middles = triangles[far], middles[far]
    return Surface.from_mesh(vertices, triangles, normals)


def seen(unseen: Surface, towards: float = 1.0) -> Surface:
    """The surface as cameras leave it that look along the axis (``towards`` -1: against it)."""
    s, _ = to_axis(unseen.vertices_mm + unseen.origin_mm)
    nearest_mm = 15 + BEND_MM * (s if towards > 0 else SWEEP - s)
    count = len(s)
    return unseen.with_coverage(np.full(count, 5, np.int32), nearest_mm.astype(np.float32))


def fitted(mesh: Surface, source: Path | str = "nowhere") -> Twin:
    """A twin with materials that vary over ``mesh``, and a light that saturates nothing beyond 6 mm."""
    x, y, z = (mesh.vertices_mm + mesh.origin_mm).T.astype(np.float32)
    wave = 0.5 + 0.25 * np.sin(x) * np.cos(0.7 * y) + 0.25 * np.sin(0.5 * z)
    materials = Materials(
        np.stack([0.3 + 0.4 * wave, 0.2 + 0.2 * wave, 0.1 + 0.2 * wave], axis=1).astype(np.float32),
        (0.4 + 0.3 * wave).astype(np.float32),
        (0.02 * wave).astype(np.float32),
    )
    light, response = Light(L0=20.0, n=2.0, q=2.0), Response(gamma=1 / 2.2)
    return Twin(mesh, CAMERA, Source(str(source), "c3vd"), materials, light, response)


def photographed(twin: Twin, camera: Camera, poses: np.ndarray) -> Samples:
    """All pixels of ``twin`` as rendered from ``poses`` [F, 4, 4], as training samples."""
    renderer, caster, parts = Renderer(twin, camera), Caster(twin.surface), []
    for frame, pose in enumerate(poses):
        photo = np.uint8(renderer.view(pose).color * 255 + 0.5)
        hits = caster.cast(camera, pose)
        parts.append(
            {
                **vars(incidence(hits, twin.surface, camera, pose)),
                "triangle": hits.triangle.astype(np.int64),
                "barycentric": hits.barycentric,
                "color": photo.reshape(-1, 3)[hits.pixel],
                "frame": np.full(len(hits), frame, np.int32),
                "pixel": hits.pixel,
            }
        )
    columns = {name: torch.from_numpy(np.concatenate([part[name] for part in parts])) for name in parts[0]}
    mask = np.ones((camera.height, camera.width), bool)
    views = Views(camera, mask, np.arange(len(poses)), twin.surface.to_local(poses))
    return Samples(**columns, views=views)[torch.argsort(columns["triangle"], stable=True)]


def state_of(twin: Twin) -> State:
    """The state of a fit that has found all of ``twin``, which has no metallic."""
    shown = torch.from_numpy(twin.materials.base_color) ** twin.response.gamma
    rough = torch.tensor([roughness_to_raw(float(value)) for value in twin.materials.roughness])
    mean = torch.cat([shown, rough[:, None]], dim=1).float()
    operator = HashOperator.each(len(mean), 0.4)
    table = torch.zeros(operator.forward_csr.shape[1], 4)
    return State(operator, mean, table, Globals.of(twin.light, twin.response, twin.materials.f0))


def seen_by_the_fit(twin: Twin, samples: Samples, state: State, effects: Effects) -> GaussNewton:
    """A solver of ``samples`` of the twin, lit as a fit that has found ``state`` and ``effects`` has them."""
    surface, caster = twin.surface, Caster(twin.surface)
    # The fit would find its own gains again, of photos without one.
    relighting = Relighting(surface, caster, effects.without(["gain"]), samples.views)
    solver = GaussNewton(lit(samples, surface, caster, effects), surface.triangles, state.operator)
    relighting(solver, state)
    return solver


def shown_to_the_fit(solver: GaussNewton, state: State) -> torch.Tensor:
    """Display values of the solver's samples as the fit predicts them, [N, 3]."""
    material = at_pixels(solver.samples, solver.triangles, state.materials)
    return predict(solver.samples, material, state.shared)


def unfitted(twin: Twin) -> Twin:
    """The twin as it is before its fit."""
    return replace(twin, materials=None, light=None, response=None)

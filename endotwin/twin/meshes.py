"""A twin's surface in the hands of other libraries: trimesh, Open3D, pyvista.

Positions are those of the world, mm, float32 in Open3D and float64 in the others; triangles are
counter-clockwise seen from the lumen; vertices keep their number and order.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import open3d
    import pyvista
    import trimesh

    from endotwin.twin.twin import Twin

DISPLAY_GAMMA = 2.2
"""Of the colours that are there to be looked at; the maps themselves are linear."""


def vertex_attributes(twin: Twin) -> dict[str, np.ndarray]:
    """All that is known of each vertex, by name: the materials, [V] or [V, 3], once the twin is fitted, with
    ``film_weight`` [V] and ``film_normal`` [V, 3] (see ``Film``) where it has a film, and the coverage
    ``seen_by``, ``nearest_mm`` and ``filled`` [V] (see ``Surface``)."""
    materials = twin.materials.per_vertex if twin.fitted else {}
    surface = twin.surface
    if twin.fitted and (film := twin.materials.film) is not None:
        for name in ("weight", "normal"):
            materials[f"film_{name}"] = film.on_all(getattr(film, name), len(surface.vertices_mm))
    coverage = {name: getattr(surface, name) for name in ("seen_by", "nearest_mm", "filled")}
    return {**materials, **coverage}


def display_color(twin: Twin) -> np.ndarray:
    """Base colour as it is displayed, uint8 [V, 3]; white before the fit."""
    if not twin.fitted:
        return np.full((len(twin.surface.vertices_mm), 3), 255, np.uint8)
    return np.rint(255 * np.clip(twin.materials.base_color, 0, 1) ** (1 / DISPLAY_GAMMA)).astype(np.uint8)


def world_vertices_mm(twin: Twin) -> np.ndarray:
    """Float64 [V, 3]."""
    return twin.surface.vertices_mm + twin.surface.origin_mm


def to_trimesh(twin: Twin) -> trimesh.Trimesh:
    """``twin.to_trimesh()``."""
    import trimesh

    mesh = trimesh.Trimesh(
        world_vertices_mm(twin),
        twin.surface.triangles,
        vertex_normals=twin.surface.normals,
        vertex_colors=display_color(twin),
        vertex_attributes={
            name: values.astype(np.uint8) if values.dtype == bool else values  # PLY has no bool
            for name, values in vertex_attributes(twin).items()
        },
        process=False,
    )
    mesh.units = "mm"
    return mesh


def to_open3d(twin: Twin) -> open3d.t.geometry.TriangleMesh:
    """``twin.to_open3d()``."""
    from endotwin.fusion._open3d import o3c, o3d

    def tensor(values: np.ndarray) -> o3c.Tensor:
        return o3c.Tensor(np.ascontiguousarray(values.reshape(len(values), -1)))

    mesh = o3d.t.geometry.TriangleMesh(
        tensor(world_vertices_mm(twin).astype(np.float32)), tensor(twin.surface.triangles)
    )
    mesh.vertex.normals = tensor(twin.surface.normals)
    mesh.vertex.colors = tensor(display_color(twin))
    for name, values in vertex_attributes(twin).items():
        mesh.vertex[name] = tensor(values)
    return mesh


def to_pyvista(twin: Twin) -> pyvista.PolyData:
    """``twin.to_pyvista()``."""
    import pyvista

    mesh = pyvista.PolyData.from_regular_faces(world_vertices_mm(twin), twin.surface.triangles)
    mesh.point_data["normals"] = twin.surface.normals
    mesh.point_data.active_normals_name = "normals"
    for name, values in {"rgb": display_color(twin), **vertex_attributes(twin)}.items():
        mesh.point_data[name] = values
    return mesh

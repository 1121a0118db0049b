"""PLY files of a mesh with named properties of its vertices (Turk 1994), binary."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from endotwin.run.output import whole_file
from endotwin.twin import Twin
from endotwin.twin.meshes import display_color, vertex_attributes, world_vertices_mm

TYPES = {"f": "float", "i": "int", "u": "uchar", "b": "uchar"}


def ply(columns: Mapping[str, np.ndarray], triangles: np.ndarray) -> bytes:
    """The file of vertex ``columns`` [V] each, by name, and ``triangles`` [F, 3].

    Real numbers are written as 32-bit floats, whole ones as 32 bits, bytes and truths as 8.
    """
    sizes = {"f": "<f4", "i": "<i4", "u": "u1", "b": "u1"}
    kinds = {name: values.dtype.kind for name, values in columns.items()}
    rows = np.empty(len(next(iter(columns.values()))), [(name, sizes[kinds[name]]) for name in columns])
    for name, values in columns.items():
        rows[name] = values
    faces = np.empty(len(triangles), [("count", "u1"), ("vertices", "<i4", 3)])
    faces["count"], faces["vertices"] = 3, triangles
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property {TYPES[kinds[name]]} {name}" for name in columns]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    return "\n".join([*header, ""]).encode() + rows.tobytes() + faces.tobytes()


def named(prefix: str, values: np.ndarray, letters: str) -> dict[str, np.ndarray]:
    """The columns of ``values`` [V, C], by ``prefix`` and letter."""
    return {f"{prefix}{letter}": values[:, i] for i, letter in enumerate(letters)}


def write_ply(twin: Twin, path: Path, overwrite: bool = False) -> None:
    """Write ``twin`` as one binary PLY file."""
    with whole_file(path, overwrite) as file:
        file.write_bytes(twin_ply(twin))


def twin_ply(twin: Twin) -> bytes:
    """The mesh in the world's mm: positions, normals, base colour as displayed, and every map by its name."""
    columns = {**named("", world_vertices_mm(twin), "xyz"), **named("n", twin.surface.normals, "xyz")}
    columns |= dict(zip(("red", "green", "blue"), display_color(twin).T, strict=True))
    for name, values in vertex_attributes(twin).items():
        letters = "xyz" if name.endswith("normal") else "rgb"
        columns |= named(f"{name}_", values, letters) if values.ndim == 2 else {name: values}
    return ply(columns, twin.surface.triangles)

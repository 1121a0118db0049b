"""One page that shows the twin in any browser with WebGL 2, without a network: endotwin's own light on tissue
in a shader, on the whole mesh.

``VIEW.html#along=8&bare`` shows nothing but the view from the ninth recorded pose. Cast shadows and bounced
light are not in it.
"""

from __future__ import annotations

import base64
import gzip
import json
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from string import Template

import numpy as np
from scipy.spatial.transform import Rotation

from endotwin.cameras.perspective import as_pinhole
from endotwin.export.appearance import Appearance, diffuse_color
from endotwin.run.output import whole_file
from endotwin.synth.trajectories.recorded import path_or_flight
from endotwin.twin import Twin

VERTEX = np.dtype([("place", "<u2", 4), ("facing", "<i2", 2), ("color", "u1", 4)])
WET = np.dtype([("facing", "<i2", 2), ("weight", "<f4")])
PARTS = {"vertex": "vertex.glsl", "fragment": "fragment.glsl", "script": "view.js"}


def write_html(twin: Twin, path: Path, overwrite: bool = False) -> None:
    """Write the page of ``twin``."""
    with whole_file(path, overwrite) as file:
        file.write_text(page(twin), encoding="utf-8")


def page(twin: Twin) -> str:
    """The page, with all that it needs."""
    folder = files("endotwin.export") / "page"
    parts = {part: (folder / name).read_text(encoding="utf-8") for part, name in PARTS.items()}
    surface = twin.surface
    low, extent = surface.vertices_mm.min(axis=0), np.ptp(surface.vertices_mm, axis=0)
    scene = {
        "appearance": Appearance.of(twin).to_dict(),
        "lens": asdict(as_pinhole(twin.camera)),
        "path": _path(surface.to_local(path_or_flight(twin))),
        "low": low.tolist(),
        "extent": extent.tolist(),
        "vertices": len(surface.vertices_mm),
        "triangles": len(surface.triangles),
    }
    parts_of_mesh = (_vertices(twin, low, extent), surface.triangles.astype("<u4"), _wet(twin))
    content = b"".join(part.tobytes() for part in parts_of_mesh)
    mesh = base64.b64encode(gzip.compress(content, 9, mtime=0)).decode()
    template = Template((folder / "page.html").read_text(encoding="utf-8"))
    title = f"endotwin: {Path(twin.source.path).name}".replace("&", "&amp;").replace("<", "&lt;")
    return template.substitute(parts, title=title, scene=json.dumps(scene).replace("<", "\\u003c"), mesh=mesh)


def _vertices(twin: Twin, low: np.ndarray, extent: np.ndarray) -> np.ndarray:
    """Vertices of 16 bytes, VERTEX [V]: the whole mesh within a thousandth of a mm and half an 8-bit step."""
    rows = np.zeros(len(twin.surface.vertices_mm), VERTEX)
    within = (twin.surface.vertices_mm - low) / np.maximum(extent, 1e-6)
    rows["place"] = np.rint(65535 * np.clip(np.c_[within, twin.materials.roughness], 0, 1))
    rows["facing"] = np.rint(32767 * _folded(twin.surface.normals))
    rows["color"][:, :3] = np.rint(255 * np.sqrt(np.clip(diffuse_color(twin), 0, 1)))
    return rows


def _wet(twin: Twin) -> np.ndarray:
    """The film on each vertex, WET [V]; [0] without one."""
    film, count = twin.film, len(twin.surface.vertices_mm)
    if film is None:
        return np.zeros(0, WET)
    rows = np.zeros(count, WET)
    rows["facing"] = film.on_all(np.rint(32767 * _folded(film.normal)), count)
    rows["weight"] = film.on_all(film.weight, count)
    return rows


def _folded(normals: np.ndarray) -> np.ndarray:
    """Unit vectors [V, 3] on the octahedron, unfolded to [−1, 1]² [V, 2] (Cigolle et al. 2014)."""
    x, y, z = (normals / np.maximum(np.abs(normals).sum(axis=1, keepdims=True), 1e-12)).T
    sign_x, sign_y = np.where(x < 0, -1, 1), np.where(y < 0, -1, 1)
    behind = z < 0
    return np.c_[np.where(behind, (1 - np.abs(y)) * sign_x, x), np.where(behind, (1 - np.abs(x)) * sign_y, y)]


def _path(poses: np.ndarray) -> list[list[float]]:
    """Position and quaternion (x, y, z, w) of each pose."""
    if not len(poses):
        return []
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    return np.round(np.c_[poses[:, :3, 3], turns], 7).tolist()

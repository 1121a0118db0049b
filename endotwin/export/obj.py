"""Wavefront OBJ with its material and textures, in the world's mm (OpenCV's axes, as the poses are).

The mesh is the last to get its name: before, nothing refers to the material and the pictures.
"""

from __future__ import annotations

import hashlib
import io
import re
from pathlib import Path

import numpy as np

from endotwin.export.appearance import Appearance
from endotwin.export.glb import png, srgb
from endotwin.export.textured import Textured, textured
from endotwin.run.output import write_with_parts
from endotwin.twin import Twin

MATERIAL = """# endotwin: light L0 {L0:.6g}, n {n:.6g}, q {q:.6g}; display = {displayed}; f0 {f0:.6g}
newmtl tissue
Kd 1 1 1
Ks {f0:.6g} {f0:.6g} {f0:.6g}
illum 2
map_Kd {stem}_base_color.png
Pr 1
map_Pr {stem}_roughness.png
Pm 0
Pc {coat_weight:.6g}
Pcr {coat_roughness:.6g}
norm {stem}_normal.png
"""
"""Pr, Pm, Pc, Pcr, map_Pr and norm are the usual extension for physically based materials."""


def write_obj(twin: Twin, path: Path, overwrite: bool = False) -> None:
    """Write ``twin`` as ``path`` and, beside it, its ``.mtl`` and three pictures, named by their checksum."""
    path = Path(path)
    mesh, look = textured(twin), Appearance.of(twin)
    pictures = {
        "base_color": png(srgb(mesh.base_color)),
        "roughness": png(mesh.roughness),
        "normal": png(mesh.normal / 2 + 0.5),
    }
    told = {"displayed": look.displayed, "coat_weight": look.coat_weight, **look.to_dict()}
    material = MATERIAL.format(stem="{stem}", **told)
    checksum = hashlib.sha256(b"".join([material.encode(), *pictures.values()])).hexdigest()[:16]
    stem = f"{path.stem}-{checksum}"
    parts = {f"{stem}_{part}.png": picture for part, picture in pictures.items()}
    parts[f"{stem}.mtl"] = material.format(stem=stem).encode()
    own = re.compile(rf"{re.escape(path.stem)}-[0-9a-f]{{16}}(\.mtl|_({'|'.join(pictures)})\.png)")
    write_with_parts(path, _mesh(mesh, twin.surface.origin_mm, stem), parts, own, overwrite)


def _mesh(mesh: Textured, origin_mm: np.ndarray, stem: str) -> bytes:
    text = io.StringIO()
    text.write(f"# endotwin, mm\nmtllib {stem}.mtl\no tissue\nusemtl tissue\n")
    np.savetxt(text, mesh.vertices_mm + origin_mm, "v %.5f %.5f %.5f")
    np.savetxt(text, np.c_[mesh.uv[:, 0], 1 - mesh.uv[:, 1]], "vt %.6f %.6f")
    np.savetxt(text, mesh.normals, "vn %.5f %.5f %.5f")
    np.savetxt(text, np.repeat(mesh.triangles + 1, 3, axis=1), "f " + " ".join(["%d/%d/%d"] * 3))
    return text.getvalue().encode()

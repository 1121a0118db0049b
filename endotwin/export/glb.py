"""glTF 2.0 in one file: textured mesh, camera path, and light guides parented to the camera.

glTF has metres and Y up: the world of the photos (OpenCV's: y down, z forward) is turned half about x. Where
glTF's model is coarser than the twin's, ``extras`` has the exact numbers (``Appearance``).
"""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from endotwin.cameras.perspective import as_pinhole, height_degrees
from endotwin.export.appearance import Appearance
from endotwin.export.textured import Textured, textured
from endotwin.light.shading import F0_DIELECTRIC, ROUGHNESS_MIN
from endotwin.run.output import whole_file
from endotwin.synth.trajectories.recorded import path_or_flight
from endotwin.twin import Twin

M_PER_MM = 1e-3
TURN = np.diag([1.0, -1.0, -1.0])
"""From OpenCV's axes to glTF's, of the world and of cameras."""

FLOAT, UINT = 5126, 5125
ARRAY_BUFFER, ELEMENT_BUFFER = 34962, 34963
KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
PATH_FPS = 10.0
NEAR_M, FAR_M = 1e-4, 1.0
LIGHTS, COAT, SPECULAR = "KHR_lights_punctual", "KHR_materials_clearcoat", "KHR_materials_specular"


def write_glb(twin: Twin, path: Path, overwrite: bool = False) -> None:
    """Write ``twin`` as one binary glTF file."""
    with whole_file(path, overwrite) as file:
        file.write_bytes(glb(twin))


def glb(twin: Twin) -> bytes:
    """The file of a fitted twin."""
    look, mesh, poses = Appearance.of(twin), textured(twin), path_or_flight(twin)
    parts = _Parts()
    document = {
        "asset": {"version": "2.0", "generator": "endotwin"},
        "extensionsUsed": sorted({LIGHTS, SPECULAR} | ({COAT} if look.coat_f0 or look.film_f0 else set())),
        "scene": 0,
        "extras": {"mm_per_unit": 1 / M_PER_MM, "endotwin": look.to_dict()},
        **_material(parts, look, mesh),
        "meshes": [{"name": "tissue", "primitives": [_primitive(parts, mesh)]}],
        "cameras": [_camera(twin)],
        "extensions": {LIGHTS: {"lights": [_spot(look)]}},
    }
    tissue = {"name": "tissue", "mesh": 0, "translation": _turned(twin.surface.origin_mm)}
    guides = [_guide(number, guide_mm) for number, guide_mm in enumerate(look.guides_mm)]
    camera = {"name": "camera", "camera": 0, "children": list(range(2, 2 + len(guides)))}
    if len(poses):
        places, turns = path_in_m(poses)
        camera |= {"translation": places[0].tolist(), "rotation": turns[0].tolist()}
        document["animations"] = [_animation(parts, places, turns)]
    document["nodes"] = [tissue, camera, *guides]
    document["scenes"] = [{"name": "endotwin", "nodes": [0, 1]}]
    document |= parts.document
    return _packed(document, bytes(parts.content))


class _Parts:
    """The binary part of the file, and what the document says of it."""

    def __init__(self) -> None:
        self.content = bytearray()
        self._views: list[dict] = []
        self._accessors: list[dict] = []

    @property
    def document(self) -> dict:
        buffers = [{"byteLength": len(self.content)}]
        return {"buffers": buffers, "bufferViews": self._views, "accessors": self._accessors}

    def view(self, content: bytes, **more) -> int:
        """Append ``content``; the index of its view."""
        self.content += bytes(-len(self.content) % 4)
        self._views.append({"buffer": 0, "byteOffset": len(self.content), "byteLength": len(content), **more})
        self.content += content
        return len(self._views) - 1

    def array(self, values: np.ndarray, target: int | None = None, bounds: bool = False) -> int:
        """Append ``values`` [N] or [N, C], float32 or uint32; the index of its accessor."""
        kind = UINT if values.dtype == np.uint32 else FLOAT
        view = self.view(values.tobytes(), **({"target": target} if target else {}))
        rows = values.reshape(len(values), -1)
        accessor = {"bufferView": view, "componentType": kind, "count": len(rows)}
        accessor["type"] = KINDS[rows.shape[1]]
        if bounds:
            accessor |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        self._accessors.append(accessor)
        return len(self._accessors) - 1


def _primitive(parts: _Parts, mesh: Textured) -> dict:
    turn = TURN.astype(np.float32)
    tangents = np.c_[mesh.tangents[:, :3] @ turn, mesh.tangents[:, 3:]].astype(np.float32)
    places = (mesh.vertices_mm @ turn * M_PER_MM).astype(np.float32)
    attributes = {
        "POSITION": parts.array(places, ARRAY_BUFFER, bounds=True),
        "NORMAL": parts.array(mesh.normals @ turn, ARRAY_BUFFER),
        "TANGENT": parts.array(tangents, ARRAY_BUFFER),
        "TEXCOORD_0": parts.array(mesh.uv, ARRAY_BUFFER),
    }
    corners = parts.array(mesh.triangles.astype(np.uint32).ravel(), ELEMENT_BUFFER)
    return {"attributes": attributes, "indices": corners, "material": 0}


def _material(parts: _Parts, look: Appearance, mesh: Textured) -> dict:
    """Material, textures and images.

    Han & Wu's metallic darkens the diffuse lobe alone, where glTF's turns into the highlight's colour: it is
    in the base colour, and glTF's is 0.
    """
    rough = np.zeros((*mesh.roughness.shape, 3), np.float32)
    rough[..., 1] = np.maximum(mesh.roughness, ROUGHNESS_MIN)
    pictures = {"base colour": png(srgb(mesh.base_color)), "roughness": png(rough)}
    pictures["normal"] = png(mesh.normal / 2 + 0.5)
    shine = {"specularFactor": 1.0, "specularColorFactor": [look.f0 / F0_DIELECTRIC] * 3}
    extensions = {SPECULAR: shine}
    if look.film_f0:
        extensions[COAT] = _film(look, mesh, pictures)
    elif look.coat_f0:
        weight, roughness = look.coat_weight, look.coat_roughness
        extensions[COAT] = {"clearcoatFactor": weight, "clearcoatRoughnessFactor": roughness}
    images = [
        {"name": name, "mimeType": "image/png", "bufferView": parts.view(picture)}
        for name, picture in pictures.items()
    ]
    surface = {
        "baseColorTexture": {"index": 0},
        "metallicRoughnessTexture": {"index": 1},
        "metallicFactor": 0.0,
    }
    material = {"name": "tissue", "pbrMetallicRoughness": surface, "normalTexture": {"index": 2}}
    return {
        "images": images,
        "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
        "textures": [{"source": index, "sampler": 0} for index in range(len(images))],
        "materials": [{**material, "doubleSided": True, "extensions": extensions}],
    }


def _film(look: Appearance, mesh: Textured, pictures: dict[str, bytes]) -> dict:
    """The film, and the coat where no film is, as a clear coat; its textures are added to ``pictures``.

    Its lobe is so narrow that its normals need 16 bits."""
    factor = np.maximum(mesh.film_weight * look.film_f0, look.coat_f0) / F0_DIELECTRIC
    wet = mesh.film_weight * look.film_f0 > look.coat_f0
    coat = np.zeros((*factor.shape, 3), np.float32)
    coat[..., 0], coat[..., 1] = factor, np.where(wet, look.film_roughness, look.coat_roughness)
    normal = np.where(wet[..., None], mesh.film_normal, mesh.normal) / 2 + 0.5
    textures = {"film": png(coat), "film normal": png(normal, np.uint16)}
    first = len(pictures)
    pictures.update(textures)
    return {
        "clearcoatFactor": 1.0,
        "clearcoatTexture": {"index": first},
        "clearcoatRoughnessFactor": 1.0,
        "clearcoatRoughnessTexture": {"index": first},
        "clearcoatNormalTexture": {"index": first + 1},
    }


def _camera(twin: Twin) -> dict:
    lens = as_pinhole(twin.camera)
    height = math.radians(height_degrees(lens))
    sees = {"yfov": height, "aspectRatio": lens.width / lens.height, "znear": NEAR_M, "zfar": FAR_M}
    return {"name": "lens", "type": "perspective", "perspective": sees}


def _spot(look: Appearance) -> dict:
    """One guide: glTF's spots fall as ((cosθ − cosθ₁)/(1 − cosθ₁))² to the edge θ₁ of their cone, which is
    cos² where that is 90°; a narrower light has the cone that halves where cosⁿ does."""
    half = 0.5 ** (1 / max(look.n, 2.0))
    edge = math.acos(min(max((half - math.sqrt(0.5)) / (1 - math.sqrt(0.5)), 0.0), 0.999))
    return {
        "name": "light guide",
        "type": "spot",
        "color": [1.0, 1.0, 1.0],
        "intensity": look.intensity_mm2 * M_PER_MM**2 / len(look.guides_mm),
        "spot": {"innerConeAngle": 0.0, "outerConeAngle": edge},
    }


def _guide(number: int, guide_mm: tuple[float, float, float]) -> dict:
    place = _turned(np.asarray(guide_mm))
    return {"name": f"guide {number}", "translation": place, "extensions": {LIGHTS: {"light": 0}}}


def path_in_m(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Translations float32 [N, 3] and unit quaternions [N, 4] (x, y, z, w) of a path, of one sign."""
    places = (poses[:, :3, 3] @ TURN * M_PER_MM).astype(np.float32)
    turns = Rotation.from_matrix(TURN @ poses[:, :3, :3] @ TURN).as_quat()
    for i in range(1, len(turns)):
        turns[i] *= 1 if turns[i] @ turns[i - 1] >= 0 else -1
    return places, turns.astype(np.float32)


def _animation(parts: _Parts, places: np.ndarray, turns: np.ndarray) -> dict:
    times = parts.array((np.arange(len(places)) / PATH_FPS).astype(np.float32), bounds=True)
    samplers = [{"input": times, "output": parts.array(values)} for values in (places, turns)]
    channels = [
        {"sampler": index, "target": {"node": 1, "path": name}}
        for index, name in enumerate(("translation", "rotation"))
    ]
    return {"name": "camera path", "samplers": samplers, "channels": channels}


def _turned(place_mm: np.ndarray) -> list[float]:
    return (TURN @ place_mm * M_PER_MM + 0.0).tolist()


def srgb(linear: np.ndarray) -> np.ndarray:
    """Linear values as sRGB (IEC 61966-2-1)."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def png(picture: np.ndarray, kind: type = np.uint8) -> bytes:
    """A picture [H, W, 3], RGB in [0, 1], or [H, W], as a PNG file of unsigned numbers of that ``kind``."""
    values = np.rint(np.clip(picture, 0, 1) * np.iinfo(kind).max).astype(kind)
    return cv2.imencode(".png", values[..., ::-1] if values.ndim == 3 else values)[1].tobytes()


def _packed(document: dict, content: bytes) -> bytes:
    """The two chunks of a GLB (glTF 2.0, section 4.4)."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    content += bytes(-len(content) % 4)
    size = 12 + 8 + len(text) + 8 + len(content)
    chunks = (
        struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(content), b"BIN\0") + content
    )
    return struct.pack("<4sII", b"glTF", 2, size) + chunks

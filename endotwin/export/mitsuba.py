"""A scene folder for Mitsuba 3: mesh with materials, projectors with the light's profile, a camera that takes
its pose as a parameter.

Its light falls as 1/d², and bounces to the end where the twin has interreflection. Lens distortion,
vignetting, gain and what else happens in a camera are not in the scene.
"""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from xml.etree import ElementTree as xml

import numpy as np

from endotwin.cameras.perspective import as_pinhole
from endotwin.export.appearance import Appearance, diffuse_color
from endotwin.export.ply import named, ply
from endotwin.light.film import Film
from endotwin.light.guides import AT_LENS, log_axis
from endotwin.light.incidence import COS_MIN
from endotwin.light.shading import ROUGHNESS_MIN
from endotwin.run.output import write_folder_anew
from endotwin.surface import Surface
from endotwin.surface.vectors import dot, unit
from endotwin.synth.trajectories.recorded import path_or_flight
from endotwin.twin import Twin
from endotwin.twin.meshes import world_vertices_mm

SCENE = "scene.xml"
OWN = re.compile(r"scene\.xml|tissue\.ply|profile\.pfm|poses\.txt|endotwin\.json")
FIELD_DEGREES = (60.0, 170.0)
"""Least and greatest field of a projector."""

MARGIN, NEAREST_MM = 1.05, 1.0
PROFILE_SIZE = 1024
DIRECT, BOUNCES = 2, 24
"""Longest paths without and with light from other tissue."""

TO_OPENCV = {"x": "-1", "y": "-1"}
"""Mitsuba's cameras have x left and y up."""

WORDS = """
A twin of endotwin's. Lengths are mm; pixels are radiance x, and the picture is {displayed}, clipped.
Choose the pose of camera and light (camera to world, 16 numbers row by row; poses.txt has the recorded ones):
  mitsuba scene.xml -Dpose="..."    or    mitsuba.load_file("scene.xml", pose="...")
"""


def write_mitsuba(twin: Twin, path: Path, overwrite: bool = False) -> None:
    """Write the scene of ``twin`` as the folder ``path``."""
    look, poses, field = Appearance.of(twin), path_or_flight(twin), field_degrees(twin)
    lobes = _lobes(look)
    files = {
        "tissue.ply": _mesh(twin, look, len(lobes)),
        "profile.pfm": _profile(look, field),
        "poses.txt": "".join(f"{matrix(pose)}\n" for pose in poses).encode(),
        "endotwin.json": (json.dumps(look.to_dict(), indent=1) + "\n").encode(),
        SCENE: _scene(twin, look, lobes, poses[0] if len(poses) else np.eye(4), field),
    }
    write_folder_anew(path, files, SCENE, OWN, overwrite)


def matrix(pose: np.ndarray) -> str:
    """A pose [4, 4] as the scene's parameter ``pose``."""
    return " ".join(f"{value:.9g}" for value in np.asarray(pose, np.float64).ravel())


def field_degrees(twin: Twin) -> float:
    """Field of the projectors: all that the camera sees beyond NEAREST_MM, as far as a projector can."""
    aside_mm = float(np.abs(np.asarray(twin.effects.guides_mm or AT_LENS)).max())
    rays = twin.camera.pixel_directions.reshape(-1, 3)
    ahead = rays[np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0)]
    reach = MARGIN * float(np.abs(ahead[:, :2] / ahead[:, 2:]).max()) + aside_mm / NEAREST_MM
    return float(np.clip(2 * math.degrees(math.atan(reach)), *FIELD_DEGREES))


def _mesh(twin: Twin, look: Appearance, scale: int) -> bytes:
    """The mesh, with the materials as attributes; base colour and the film's reflectance times ``scale``."""
    places, normals = world_vertices_mm(twin), twin.surface.normals
    triangles, row, film = twin.surface.triangles, slice(None), {}
    if look.film_f0:
        triangles, row, film = _wet(twin.film, twin.surface, scale * look.film_f0)
    columns = {**named("", places[row], "xyz"), **named("n", normals[row], "xyz")}
    columns |= named("base_color_", scale * diffuse_color(twin)[row], "012")
    columns["roughness_0"] = np.maximum(twin.materials.roughness[row], ROUGHNESS_MIN)
    return ply(columns | film, triangles)


def _wet(film: Film, surface: Surface, f0: float) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """The film as attributes of a mesh whose wet triangles have corners of their own: the frame that a normal
    map of Mitsuba's is in has its first axis along the first edge of each triangle.

    Returns:
        triangles [F, 3]; for each vertex of the new mesh the one that it was, [W]; columns [W].
    """
    count = len(surface.vertices_mm)
    weight = film.on_all(film.weight, count)
    wet = (weight[surface.triangles] > 0).any(axis=1)
    corners = surface.triangles[wet]
    row = np.concatenate([np.arange(count), corners.ravel()])
    triangles = surface.triangles.copy()
    triangles[wet] = count + np.arange(corners.size).reshape(-1, 3)
    level = surface.normals + 0.0
    level[film.vertex] = film.normal
    wettest = np.take_along_axis(corners, weight[corners].argmax(axis=1)[:, None], axis=1)
    own = np.where(weight[corners] > 0, corners, wettest)  # a dry corner levels off as the wettest one
    first = surface.vertices_mm[corners[:, 1]] - surface.vertices_mm[corners[:, 0]]
    along = np.repeat(first, 3, axis=0)
    facing = surface.normals[corners.ravel()]
    along = unit(along - dot(along, facing)[:, None] * facing)
    normal = level[own.ravel()]
    local = np.stack([dot(normal, along), dot(normal, np.cross(facing, along)), dot(normal, facing)], axis=1)
    mirror = np.concatenate([np.tile(np.float32([0, 0, 1]), (count, 1)), local]) / 2 + 0.5
    mirrored = np.repeat(f0 * weight[row][:, None], 3, axis=1)
    return triangles, row, {**named("film_", mirrored, "012"), **named("mirror_", mirror, "012")}


def _profile(look: Appearance, field: float) -> bytes:
    """What a projector must show, as a PFM picture, for intensity 1 on its axis.

    It shines E·π/cos³θ for a picture E: its pictures are what falls on a plane.
    """
    reach = math.tan(math.radians(field) / 2)
    x = reach * ((np.arange(PROFILE_SIZE) + 0.5) / PROFILE_SIZE * 2 - 1)
    cos = 1 / np.sqrt(1 + x[:, None] ** 2 + x[None] ** 2)
    shape = np.exp(look.n * log_axis(np.maximum(cos, COS_MIN), look.profile))
    picture = (shape * cos**3 / math.pi).astype("<f4")
    return f"Pf\n{PROFILE_SIZE} {PROFILE_SIZE}\n-1.0\n".encode() + picture.tobytes()


def _lobes(look: Appearance) -> list[xml.Element]:
    """What the tissue answers light with. Mitsuba has no sum of lobes, only means: of K lobes each is K times
    as strong."""
    count = 1 + (not look.burley) + (look.coat_f0 > 0) + (look.film_f0 > 0)
    shine = _attribute("roughness", "vertex_roughness")
    if look.burley:
        lobes = [_lobe("principled", _attribute("base_color", "vertex_base_color"), shine, look.f0 * count)]
    else:
        lobes = [_lobe("diffuse", _attribute("reflectance", "vertex_base_color"))]
        lobes.append(_lobe("principled", _black(), shine, look.f0 * count))
    if look.coat_f0 > 0:
        roughness = _value("float", "roughness", look.coat_roughness)
        lobes.append(_lobe("principled", _black(), roughness, look.coat_f0 * count))
    if look.film_f0 > 0:
        metal, roughness = _value("float", "metallic", 1), _value("float", "roughness", look.film_roughness)
        film = _lobe("principled", _attribute("base_color", "vertex_film"), metal, roughness)
        plain = _value("boolean", "use_shadowing_function", "false")
        lobes.append(_lobe("normalmap", _attribute("normalmap", "vertex_mirror"), plain, film))
    return lobes


def _lobe(kind: str, *parts: xml.Element | float) -> xml.Element:
    """A BSDF of ``parts``; a number is its reflectance at normal incidence, ((η − 1)/(η + 1))²."""
    lobe = xml.Element("bsdf", type=kind)
    for part in parts:
        if isinstance(part, float):
            root = math.sqrt(min(max(part, 1e-6), 0.99))
            part = _value("float", "eta", (1 + root) / (1 - root))
        lobe.append(part)
    return lobe


def _mean(lobes: list[xml.Element]) -> xml.Element:
    """A BSDF that is the mean of ``lobes``."""
    if len(lobes) == 1:
        return lobes[0]
    blend = xml.Element("bsdf", type="blendbsdf")
    blend.append(_value("float", "weight", 1 - 1 / len(lobes)))
    blend.extend([lobes[0], _mean(lobes[1:])])
    return blend


def _scene(twin: Twin, look: Appearance, lobes: list[xml.Element], pose: np.ndarray, field: float) -> bytes:
    scene = xml.Element("scene", version="3.0.0")
    scene.append(xml.Comment(WORDS.format(displayed=look.displayed)))
    xml.SubElement(scene, "default", name="pose", value=matrix(pose))
    xml.SubElement(scene, "default", name="spp", value="64")
    integrator = xml.SubElement(scene, "integrator", type="path")
    integrator.append(_value("integer", "max_depth", BOUNCES if look.bounce else DIRECT))
    scene.append(_sensor(twin))
    for guide_mm in look.guides_mm:
        scene.append(_projector(guide_mm, look.intensity_mm2 / len(look.guides_mm), field))
    shape = xml.SubElement(scene, "shape", type="ply")
    shape.append(_value("string", "filename", "tissue.ply"))
    shape.append(_mean(lobes))
    xml.indent(scene)
    return xml.tostring(scene, encoding="utf-8", xml_declaration=True)


def _sensor(twin: Twin) -> xml.Element:
    lens = as_pinhole(twin.camera)
    sensor = xml.Element("sensor", type="perspective")
    sensor.append(_at((0.0, 0.0, 0.0)))
    values = {
        "fov": math.degrees(2 * math.atan(lens.width / 2 / lens.fx)),
        "principal_point_offset_x": 0.5 - (lens.cx + 0.5) / lens.width,
        "principal_point_offset_y": 0.5 - (lens.cy + 0.5) / lens.height,
        "near_clip": 0.1,
        "far_clip": 2000.0,
    }
    sensor.extend(_value("float", name, value) for name, value in values.items())
    sensor.append(_value("string", "fov_axis", "x"))
    film = xml.SubElement(sensor, "film", type="hdrfilm")
    film.extend([_value("integer", "width", lens.width), _value("integer", "height", lens.height)])
    xml.SubElement(film, "rfilter", type="box")
    xml.SubElement(sensor, "sampler", type="multijitter").append(_value("integer", "sample_count", "$spp"))
    return sensor


def _projector(guide_mm: tuple[float, float, float], intensity: float, field: float) -> xml.Element:
    light = xml.Element("emitter", type="projector")
    light.append(_at(guide_mm))
    picture = xml.SubElement(light, "texture", type="bitmap", name="irradiance")
    picture.extend([_value("string", "filename", "profile.pfm"), _value("boolean", "raw", "true")])
    light.extend([_value("float", "scale", intensity), _value("float", "fov", field)])
    return light


def _at(place_mm: tuple[float, float, float]) -> xml.Element:
    """Whatever looks along the camera's axis from ``place_mm`` in the camera frame."""
    transform = xml.Element("transform", name="to_world")
    xml.SubElement(transform, "scale", **TO_OPENCV)
    xml.SubElement(transform, "translate", **dict(zip("xyz", map(repr, map(float, place_mm)), strict=True)))
    xml.SubElement(transform, "matrix", value="$pose")
    return transform


def _value(kind: str, name: str, value: object) -> xml.Element:
    return xml.Element(kind, name=name, value=str(value))


def _attribute(name: str, of_mesh: str) -> xml.Element:
    texture = xml.Element("texture", type="mesh_attribute", name=name)
    texture.append(_value("string", "name", of_mesh))
    return texture


def _black() -> xml.Element:
    return _value("rgb", "base_color", "0 0 0")

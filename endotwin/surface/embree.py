"""What embreex does not offer of the Embree that it brings along.

The handle of embreex's scene is read from where the ``.pxd`` files that it ships say that it lies; unless all
that lies about it is what must be there, there is no handle.
"""

from __future__ import annotations

import ctypes
from ctypes import c_int, c_size_t, c_uint, c_void_p, sizeof
from functools import cache
from pathlib import Path

import embreex
import numpy as np
from embreex import rtcore, rtcore_scene
from embreex.mesh_construction import TriangleMesh

SIGN = 0x5AFE
"""Written through embreex, and found again where it must lie."""

PLACES = (".", "../embreex.libs", ".dylibs")
"""Where wheels put the libraries that they bring along."""

FIRST = 0
TRIANGLES, VERTICES = 0, 1
UINT3, FLOAT3 = 0x5003, 0x9003
"""Of Embree 4's rtcore_buffer.h."""

SIXTEEN_RAYS = 34
"""Of Embree 4's rtcore_device.h."""

FLOATS = 4
"""Of a vertex in a buffer: x, y, z and one to fill it up."""

FUNCTIONS = (
    ("rtcSetSceneFlags", c_void_p, c_int),
    ("rtcSetSceneBuildQuality", c_void_p, c_int),
    ("rtcCommitScene", c_void_p),
    ("rtcSetGeometryBuildQuality", c_void_p, c_int),
    ("rtcUpdateGeometryBuffer", c_void_p, c_int, c_uint),
    ("rtcCommitGeometry", c_void_p),
    ("rtcGetGeometry", c_void_p, c_uint),
    ("rtcGetGeometryBufferData", c_void_p, c_int, c_uint),
    ("rtcSetNewGeometryBuffer", c_void_p, c_int, c_uint, c_int, c_size_t, c_size_t),
    ("rtcGetSceneDevice", c_void_p),
    ("rtcGetDeviceProperty", c_void_p, c_int),
    ("rtcReleaseDevice", c_void_p),
    ("rtcIntersect16", c_void_p, c_void_p, c_void_p, c_void_p),
    ("rtcOccluded16", c_void_p, c_void_p, c_void_p, c_void_p),
)


def handle(scene: rtcore_scene.EmbreeScene, device: rtcore.EmbreeDevice) -> int | None:
    """That of a ``scene`` on its ``device`` within ``loaded``; None where embreex is not as it is known
    here."""
    head, pointer = object.__basicsize__, sizeof(c_void_p)
    if loaded() is None or type(scene).__basicsize__ != head + 3 * pointer:
        return None
    committed = c_int.from_address(id(scene) + head + pointer)
    owner = c_void_p.from_address(id(scene) + head + 2 * pointer)
    before, scene.is_committed = scene.is_committed, SIGN
    is_known, scene.is_committed = committed.value == SIGN and owner.value == id(device), before
    return c_void_p.from_address(id(scene) + head).value if is_known else None


def takes_sixteen(handle: int) -> bool:
    """Whether the processor follows sixteen rays at once in the scene of this handle."""
    device = loaded().rtcGetSceneDevice(handle)  # retained
    try:
        return bool(loaded().rtcGetDeviceProperty(device, SIXTEEN_RAYS))
    finally:
        loaded().rtcReleaseDevice(device)


def mesh(
    scene: rtcore_scene.EmbreeScene,
    device: rtcore.EmbreeDevice,
    vertices_mm: np.ndarray,
    triangles: np.ndarray,
) -> TriangleMesh:
    """Vertices float32 [V, 3] and triangles int32 [F, 3] in a ``scene`` on its ``device``. The buffers are
    filled here, where that can be: embreex takes half a microsecond a triangle for it."""
    known = handle(scene, device)
    if known is None or not len(triangles):
        return TriangleMesh(scene, vertices_mm, triangles)
    made = TriangleMesh(scene, vertices_mm[:1], triangles[:0])
    geometry = c_void_p(loaded().rtcGetGeometry(known, FIRST))
    for kind, form, dtype, width, rows in (
        (VERTICES, FLOAT3, np.float32, FLOATS, vertices_mm),
        (TRIANGLES, UINT3, np.uint32, 3, triangles),
    ):
        size = width * np.dtype(dtype).itemsize
        start = loaded().rtcSetNewGeometryBuffer(geometry, kind, FIRST, form, size, len(rows))
        buffer(start, len(rows), width, dtype)[:, :3] = rows
    loaded().rtcCommitGeometry(geometry)
    return made


def buffer(start: int, rows: int, width: int, kind: np.dtype) -> np.ndarray:
    """The array [rows, width] that begins at an address."""
    memory = (ctypes.c_byte * (rows * width * np.dtype(kind).itemsize)).from_address(start)
    return np.frombuffer(memory, kind).reshape(rows, width)


@cache
def loaded() -> ctypes.CDLL | None:
    """Embree 4 as embreex has loaded it; None where that is not found."""
    package = Path(embreex.__file__).parent
    files = [file for place in PLACES for file in sorted((package / place).glob("*embree4*"))]
    try:
        found = ctypes.CDLL(str(files[0]))
        for name, *takes in FUNCTIONS:
            function = getattr(found, name)
            function.argtypes, function.restype = takes, c_void_p if "Get" in name or "New" in name else None
    except (IndexError, OSError, AttributeError):
        return None
    return found

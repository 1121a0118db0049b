"""Embree scenes whose tree of boxes is fitted to moved vertices: that takes a thirtieth of building one.

embreex builds trees, and does no more. The handle of its scene is read from where the ``.pxd`` files that it
ships say that it lies; unless all that lies about it is what must be there, there is no fitting.
"""

from __future__ import annotations

import ctypes
from ctypes import c_int, c_uint, c_void_p, sizeof
from functools import cache
from pathlib import Path
from typing import Self

import embreex
import numpy as np
from embreex import rtcore, rtcore_scene

VERTEX_BUFFER, FIRST = 1, 0
LOW, REFIT = 0, 3
DYNAMIC, ROBUST = 1, 4
"""Of Embree 4's rtcore_buffer.h, rtcore_common.h and rtcore_scene.h."""

FLOATS = 4
"""Of a vertex in embreex's buffer: x, y, z and one to fill it up."""

SIGN = 0x5AFE
"""Written through embreex, and found again where it must lie."""

PLACES = (".", "../embreex.libs", ".dylibs")
"""Where wheels put the libraries that they bring along."""


class Refit:
    """The tree of a scene with one mesh. It is built once, of the mesh as it is then, by Morton codes: in a
    quarter of the time of the usual one, and rays are as fast in it."""

    def __init__(self, library: ctypes.CDLL, scene: rtcore_scene.EmbreeScene, handle: int, vertices: int):
        self._library, self._scene, self._handle = library, scene, c_void_p(handle)
        self._geometry = c_void_p(library.rtcGetGeometry(self._handle, FIRST))
        buffer = library.rtcGetGeometryBufferData(self._geometry, VERTEX_BUFFER, FIRST)
        floats = (ctypes.c_float * (vertices * FLOATS)).from_address(buffer)
        self._vertices_mm = np.frombuffer(floats, np.float32).reshape(vertices, FLOATS)[:, :3]
        library.rtcSetSceneFlags(self._handle, DYNAMIC | ROBUST)
        library.rtcSetSceneBuildQuality(self._handle, LOW)
        library.rtcSetGeometryBuildQuality(self._geometry, LOW)
        self._commit()
        library.rtcSetGeometryBuildQuality(self._geometry, REFIT)
        self._commit()

    @classmethod
    def of(cls, scene: rtcore_scene.EmbreeScene, device: rtcore.EmbreeDevice, vertices: int) -> Self | None:
        """That of a ``scene`` on its ``device`` with one mesh of so many vertices; None
        where embreex is not as this module knows it."""
        library, head, pointer = _library(), object.__basicsize__, sizeof(c_void_p)
        if library is None or type(scene).__basicsize__ != head + 3 * pointer:
            return None
        committed = c_int.from_address(id(scene) + head + pointer)
        owner = c_void_p.from_address(id(scene) + head + 2 * pointer)
        before, scene.is_committed = scene.is_committed, SIGN
        is_known, scene.is_committed = committed.value == SIGN and owner.value == id(device), before
        if not is_known:
            return None
        return cls(library, scene, c_void_p.from_address(id(scene) + head).value, vertices)

    def move(self, vertices_mm: np.ndarray) -> None:
        """Fit the tree to the mesh's vertices float32 [V, 3] as they are now."""
        self._vertices_mm[:] = vertices_mm
        self._commit()

    def _commit(self) -> None:
        self._library.rtcUpdateGeometryBuffer(self._geometry, VERTEX_BUFFER, FIRST)
        self._library.rtcCommitGeometry(self._geometry)
        self._library.rtcCommitScene(self._handle)
        self._scene.is_committed = 1


@cache
def _library() -> ctypes.CDLL | None:
    """Embree 4 as embreex has loaded it; None where that is not found."""
    package = Path(embreex.__file__).parent
    files = [file for place in PLACES for file in sorted((package / place).glob("*embree4*"))]
    try:
        library = ctypes.CDLL(str(files[0]))
        for name, *takes in (
            ("rtcSetSceneFlags", c_void_p, c_int),
            ("rtcSetSceneBuildQuality", c_void_p, c_int),
            ("rtcCommitScene", c_void_p),
            ("rtcSetGeometryBuildQuality", c_void_p, c_int),
            ("rtcUpdateGeometryBuffer", c_void_p, c_int, c_uint),
            ("rtcCommitGeometry", c_void_p),
            ("rtcGetGeometry", c_void_p, c_uint),
            ("rtcGetGeometryBufferData", c_void_p, c_int, c_uint),
        ):
            function = getattr(library, name)
            function.argtypes, function.restype = takes, c_void_p if "Get" in name else None
    except (IndexError, OSError, AttributeError):
        return None
    return library

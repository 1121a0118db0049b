"""What embreex does not offer of the Embree that it brings along.

The handle of embreex's scene is read from where the ``.pxd`` files that it ships say that it lies; unless all
that lies about it is what must be there, there is no handle.
"""

from __future__ import annotations

import ctypes
from ctypes import c_int, c_uint, c_void_p, sizeof
from functools import cache
from pathlib import Path

import embreex
from embreex import rtcore, rtcore_scene

SIGN = 0x5AFE
"""Written through embreex, and found again where it must lie."""

PLACES = (".", "../embreex.libs", ".dylibs")
"""Where wheels put the libraries that they bring along."""

FUNCTIONS = (
    ("rtcSetSceneFlags", c_void_p, c_int),
    ("rtcSetSceneBuildQuality", c_void_p, c_int),
    ("rtcCommitScene", c_void_p),
    ("rtcSetGeometryBuildQuality", c_void_p, c_int),
    ("rtcUpdateGeometryBuffer", c_void_p, c_int, c_uint),
    ("rtcCommitGeometry", c_void_p),
    ("rtcGetGeometry", c_void_p, c_uint),
    ("rtcGetGeometryBufferData", c_void_p, c_int, c_uint),
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


@cache
def loaded() -> ctypes.CDLL | None:
    """Embree 4 as embreex has loaded it; None where that is not found."""
    package = Path(embreex.__file__).parent
    files = [file for place in PLACES for file in sorted((package / place).glob("*embree4*"))]
    try:
        found = ctypes.CDLL(str(files[0]))
        for name, *takes in FUNCTIONS:
            function = getattr(found, name)
            function.argtypes, function.restype = takes, c_void_p if "Get" in name else None
    except (IndexError, OSError, AttributeError):
        return None
    return found

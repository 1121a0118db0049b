"""Embree scenes whose tree of boxes is fitted to moved vertices: that takes a thirtieth of building one."""

from __future__ import annotations

import ctypes
from ctypes import c_void_p
from typing import Self

import numpy as np
from embreex import rtcore, rtcore_scene

from endotwin.surface import embree

LOW, REFIT = 0, 3
DYNAMIC, ROBUST = 1, 4
"""Of Embree 4's rtcore_common.h and rtcore_scene.h."""


class Refit:
    """The tree of a scene with one mesh. It is built once, of the mesh as it is then."""

    def __init__(self, library: ctypes.CDLL, scene: rtcore_scene.EmbreeScene, handle: int, vertices: int):
        self._library, self._scene, self._handle = library, scene, c_void_p(handle)
        self._geometry = c_void_p(library.rtcGetGeometry(self._handle, embree.FIRST))
        start = library.rtcGetGeometryBufferData(self._geometry, embree.VERTICES, embree.FIRST)
        self._vertices_mm = embree.buffer(start, vertices, embree.FLOATS, np.float32)[:, :3]
        library.rtcSetSceneFlags(self._handle, DYNAMIC | ROBUST)
        library.rtcSetSceneBuildQuality(self._handle, LOW)
        library.rtcSetGeometryBuildQuality(self._geometry, REFIT)
        self._commit()

    @classmethod
    def of(cls, scene: rtcore_scene.EmbreeScene, device: rtcore.EmbreeDevice, vertices: int) -> Self | None:
        """That of a ``scene`` on its ``device`` with one mesh of so many vertices; None where there is no
        handle of it."""
        handle = embree.handle(scene, device)
        return None if handle is None else cls(embree.loaded(), scene, handle, vertices)

    def move(self, vertices_mm: np.ndarray) -> None:
        """Fit the tree to the mesh's vertices float32 [V, 3] as they are now."""
        self._vertices_mm[:] = vertices_mm
        self._commit()

    def _commit(self) -> None:
        self._library.rtcUpdateGeometryBuffer(self._geometry, embree.VERTICES, embree.FIRST)
        self._library.rtcCommitGeometry(self._geometry)
        self._library.rtcCommitScene(self._handle)
        self._scene.is_committed = 1

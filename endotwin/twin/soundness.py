"""Whether what a twin's folder holds can be a twin: arrays that fit together, numbers that are numbers."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from endotwin.twin.fluids import MOST_FLUIDS
from endotwin.twin.polyps import MOST_POLYPS

if TYPE_CHECKING:
    from endotwin.light.film import Film
    from endotwin.twin.twin import Twin

SURFACE = {
    "origin_mm": (np.float64, None),
    "vertices_mm": (np.float32, 3),
    "normals": (np.float32, 3),
    "seen_by": (np.int32, 0),
    "nearest_mm": (np.float32, 0),
    "filled": (np.bool_, 0),
}
LARGEST_MM = 1e7
MATERIALS = {"base_color": (np.float32, 3), "roughness": (np.float32, 0), "metallic": (np.float32, 0)}
"""Type and columns of the arrays that have a row for each vertex (origin_mm: just three numbers)."""


def require_sound(twin: Twin) -> Twin:
    """``twin`` itself. Raises ValueError, saying what, where something in it is impossible."""
    surface = twin.surface
    count = len(surface.vertices_mm)
    for name, (kind, columns) in SURFACE.items():
        shape = (3,) if columns is None else (count, columns)[: 2 if columns else 1]
        _require_array(name, getattr(surface, name), kind, shape)
    _require_array("wall_mm", surface.wall_mm, np.float32, (len(surface.wall_mm), 3))
    for name, corners in (("triangles", count), ("wall_triangles", len(surface.wall_mm))):
        triangles = getattr(surface, name)
        _require_array(name, triangles, np.int32, (len(triangles), 3))
        _require(name, bool(((triangles >= 0) & (triangles < corners)).all()))
    for name in ("vertices_mm", "origin_mm", "normals", "wall_mm"):
        _require(name, bool(np.isfinite(getattr(surface, name)).all()))
    if not len(surface.triangles):
        raise ValueError("its surface is empty")
    size_mm = float(np.ptp(surface.vertices_mm.astype(np.float64), axis=0).max())
    if size_mm > LARGEST_MM:
        raise ValueError(f"its surface is {size_mm:.3g} mm large")
    source = twin.source
    _require("the source", isinstance(source.path, str) and isinstance(source.format, str))
    _require("the source's scale", _positive(source.scale))
    _require("the source's geometry", source.geometry in ("known", "heldout"))
    for name in ("holdout_every", "frames"):
        value = getattr(source, name)
        _require(name, (value is None and name == "frames") or (type(value) is int and value >= 1))
    _require("the record", isinstance(twin.record, dict))
    fitted = [part is not None for part in (twin.materials, twin.light, twin.response)]
    _require("the fit", all(fitted) or not any(fitted))
    ends = [0, *(end for polyp in twin.polyps for end in np.cumsum(polyp.triangles)), len(surface.triangles)]
    _require("the place of a polyp", ends == sorted(ends) and len(twin.polyps) <= MOST_POLYPS)
    for fluid in twin.fluids:
        ends = [0, *(end for run in fluid.triangles for end in np.cumsum(run)), len(surface.triangles)]
        _require("the place of a fluid", ends == sorted(ends))
    _require("the number of fluids", len(twin.fluids) <= MOST_FLUIDS)
    if all(fitted):
        _require_fit(twin, count)
    return twin


def _require_fit(twin: Twin, count: int) -> None:
    materials, light = twin.materials, twin.light
    for name, (kind, columns) in MATERIALS.items():
        values = getattr(materials, name)
        _require_array(name, values, kind, (count, columns)[: 2 if columns else 1])
        _require(name, bool(((values >= 0) & (values <= 1)).all()))
    if materials.film is not None:
        _require_film(materials.film, count)
    _require("f0", _number(materials.f0) and materials.f0 >= 0)
    _require("the diffuse lobe", materials.diffuse in ("burley", "lambert"))
    _require("the light", _positive(light.L0) and _number(light.n) and _number(light.q))
    _require("gamma", _positive(twin.response.gamma))


def _require_film(film: Film, count: int) -> None:
    size = len(film.vertex)
    for name, shape in (("normal", (size, 3)), ("weight", (size,))):
        values = getattr(film, name)
        _require("the film", values.dtype == np.float32 and values.shape == shape)
        _require("the film", bool(np.isfinite(values).all()))
    vertex = film.vertex
    _require("the film", vertex.dtype == np.int32 and vertex.ndim == 1 and bool((np.diff(vertex) > 0).all()))
    _require("the film", not size or (vertex[0] >= 0 and vertex[-1] < count and film.weight.min() >= 0))


def _require_array(name: str, values: np.ndarray, kind: type, shape: tuple[int, ...]) -> None:
    _require(name, values.dtype == kind and values.shape == shape)


def _require(name: str, good: bool) -> None:
    if not good:
        raise ValueError(f"{name} makes no sense")


def _number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _positive(value: object) -> bool:
    return _number(value) and value > 0

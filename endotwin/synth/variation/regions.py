"""Regions of the surface: a box, or vertices painted with a weight."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from endotwin.errors import OptionError
from endotwin.surface import Surface

KEYS = "name, material, and box (two corners, world mm) or vertices (a .npy or .ply file)"


@dataclass(frozen=True, eq=False)
class Region:
    """A part of the surface.

    Attributes:
        name: for the records. weight: float32 [V] in [0, 1], 1 where a vertex belongs to it.
    """

    name: str
    weight: np.ndarray

    @property
    def vertices(self) -> int:
        """How many vertices belong to it, in part or whole."""
        return int(np.count_nonzero(self.weight))


def read_region(description: object, surface: Surface, path: Path) -> Region:
    """The region that an entry of the YAML file at ``path`` describes; raises OptionError."""
    if not isinstance(description, dict) or not description.keys() <= {"name", "material", "box", "vertices"}:
        raise OptionError(f"{path}: the region {description!r} is not understood; its keys are {KEYS}")
    name = str(description.get("name", ""))
    if not name or ("box" in description) == ("vertices" in description):
        raise OptionError(f"{path}: the region {name!r} lacks a part; its keys are {KEYS}")
    if "box" in description:
        weight = _boxed(description["box"], surface, f"{path}: region {name}")
    else:
        weight = _painted(path.parent / str(description["vertices"]), surface)
    if not weight.any():
        raise OptionError(
            f"{path}: the region {name!r} holds no vertex of the surface; move its box or paint"
        )
    return Region(name, weight.astype(np.float32))


def _boxed(corners: object, surface: Surface, where: str) -> np.ndarray:
    try:
        low, high = np.sort(np.array(corners, np.float64).reshape(2, 3), axis=0)
    except (TypeError, ValueError) as error:
        raise OptionError(f"{where}: its box is not [[x, y, z], [x, y, z]], two corners in mm") from error
    points = surface.vertices_mm + surface.origin_mm
    return ((points >= low) & (points <= high)).all(axis=1)


def _painted(file: Path, surface: Surface) -> np.ndarray:
    """Weights [V]: of an array of one a vertex, or the brightness of a painted mesh's nearest vertex."""
    count = len(surface.vertices_mm)
    try:
        if file.suffix.lower() not in (".npy", ".ply"):
            raise ValueError("its name does not say which")
        if file.suffix.lower() == ".npy":
            weight = np.load(file, allow_pickle=False)
            if weight.shape != (count,) or not np.isfinite(weight.astype(np.float64)).all():
                raise ValueError(f"its shape is {weight.shape}, the surface has {count} vertices")
            return np.clip(weight, 0, 1)
        import trimesh

        mesh = trimesh.load(file, process=False, force="mesh")
        colors = np.asarray(mesh.visual.vertex_colors)[:, :3].mean(axis=1) / 255
        nearest = cKDTree(mesh.vertices).query(surface.vertices_mm + surface.origin_mm)[1]
        return colors[nearest]
    except Exception as error:  # these libraries raise whatever the wrong bytes lead them to
        raise OptionError(
            f"{file} is no vertex mask ({error}); give a .npy of one number a vertex, or a .ply of the "
            f"surface "
            "painted white on black"
        ) from error

"""The surface of the lumen: a triangle mesh with normals that point into the lumen, and what was seen of
it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np
from safetensors.numpy import load_file, save


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangle mesh about a local origin, so that float32 stays exact wherever the world's origin is.

    Attributes:
        origin_mm: float64 [3], world position of the local origin; world = vertices_mm + origin_mm.
        vertices_mm: float32 [V, 3].
        triangles: int32 [F, 3], counter-clockwise seen from the lumen.
        normals: float32 [V, 3], unit, mesh-derived, towards the lumen.
        seen_by: int32 [V], number of training frames that see the vertex.
        nearest_mm: float32 [V], least distance to a camera that sees the vertex; inf where unseen.
        filled: bool [V], true where the surface was closed over a hole rather than measured.
        wall_mm: float32 [W, 3], wall_triangles: int32 [U, 3] of these: the wall beyond what was measured, as
            it may go on. No ray of a camera meets it; it throws light on the surface.
    """

    origin_mm: np.ndarray
    vertices_mm: np.ndarray
    triangles: np.ndarray
    normals: np.ndarray
    seen_by: np.ndarray
    nearest_mm: np.ndarray
    filled: np.ndarray
    wall_mm: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    wall_triangles: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.int32))

    def __repr__(self) -> str:
        return f"Surface({len(self.vertices_mm):,} vertices, {len(self.triangles):,} triangles)"

    @classmethod
    def from_mesh(cls, vertices_world_mm: np.ndarray, triangles: np.ndarray, normals: np.ndarray) -> Surface:
        """An unseen surface from world vertices [V, 3], triangles [F, 3] and unit normals [V, 3]."""
        origin_mm = (
            np.asarray(vertices_world_mm, np.float64).mean(axis=0) if len(vertices_world_mm) else np.zeros(3)
        )
        count = len(vertices_world_mm)
        return cls(
            origin_mm=origin_mm,
            vertices_mm=(vertices_world_mm - origin_mm).astype(np.float32),
            triangles=np.ascontiguousarray(triangles, np.int32),
            normals=np.ascontiguousarray(normals, np.float32),
            seen_by=np.zeros(count, np.int32),
            nearest_mm=np.full(count, np.inf, np.float32),
            filled=np.zeros(count, bool),
        )

    def to_local(self, T_world_camera: np.ndarray) -> np.ndarray:
        """Poses [..., 4, 4] with their translation relative to ``origin_mm``, float64."""
        T_local_camera = np.array(T_world_camera, np.float64)
        T_local_camera[..., :3, 3] -= self.origin_mm
        return T_local_camera

    def to_world(self, T_local_camera: np.ndarray) -> np.ndarray:
        """The inverse of ``to_local``, poses float64 [..., 4, 4]."""
        T_world_camera = np.array(T_local_camera, np.float64)
        T_world_camera[..., :3, 3] += self.origin_mm
        return T_world_camera

    def normal_agreement(self) -> np.ndarray:
        """Least cosine between two corners' normals of each triangle, float32 [F]: 1 where it is flat."""
        normals = self.normals[self.triangles]
        return np.einsum("fik,fik->fi", normals, np.roll(normals, 1, axis=1)).min(axis=1)

    def seen(self) -> np.ndarray:
        """Triangles of which training photos saw all corners, bool [F]."""
        return (self.seen_by > 0)[self.triangles].all(axis=1)

    def with_coverage(self, seen_by: np.ndarray, nearest_mm: np.ndarray) -> Surface:
        """The same surface with other coverage [V] each."""
        return replace(self, seen_by=seen_by, nearest_mm=nearest_mm)

    def to_bytes(self) -> bytes:
        """All arrays as they are, as the content of a ``.safetensors`` file."""
        return save({name: np.ascontiguousarray(value) for name, value in vars(self).items()})

    @classmethod
    def load(cls, path: Path) -> Surface:
        """Read a file of what ``to_bytes`` gave; arrays that a surface no longer has are passed over, and
        older files have no wall."""
        arrays, names = load_file(path), {field.name for field in fields(cls)}
        return cls(**{name: array for name, array in arrays.items() if name in names})

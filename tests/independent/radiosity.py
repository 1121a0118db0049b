"""Light between all parts of a wall, to the end of its bounces.

Patches are blocks of the grid. E = K·ρ·(E_direct + E) with K the share of a patch's cosine-weighted rays that
end on each other patch (Goral et al. 1984). What white lobes make of a lamp's light goes where their facets
mirror it, and the camera is shown what facets mirror to it; all other reflection from patch to patch is
diffuse.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.sparse

from independent.gloss import reflected
from independent.light import Lamp, dot
from independent.wall import Wall, about, sampled, unit

BLOCK = 4
"""Quads of a patch, each way."""

STRATA = 24
"""Rays of a patch: their squared number, one in each cell of the unit square."""

FACETS = 4
"""That a guide lights in each triangle."""

AT_ONCE = 512
LIFT = 1e-4
CONVERGED = 1e-4
MOST_BOUNCES = 200


@dataclass(frozen=True)
class Bounce:
    """Indirect irradiance of patches in F frames, and radiosity of what they mirror to the camera, float32
    [F, R, C, 3]."""

    arriving: np.ndarray
    shown: np.ndarray

    def at(self, frame: int, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Both at places [N, 2] of the wall, interpolated between patches' centres."""
        return tuple(sampled(of[frame], place / BLOCK - 0.5) for of in (self.arriving, self.shown))


class Radiosity:
    """Patches of a wall, [R, C] of them, with the map ``tissue`` [H, W, K] over it.

    Attributes:
        shape: R, C. area_mm2: [P]. tissue: float32 [P, K], means over the patches.
        patch_of: int [T], patch of each triangle. form_factors: CSR [P, P]; a row sums to 1 where the wall is
        closed.
    """

    def __init__(self, wall: Wall, tissue: np.ndarray, rng: np.random.Generator):
        self._wall = wall
        self.shape = ((wall.shape[0] - 1) // BLOCK, wall.shape[1] // BLOCK)
        corners = wall.vertices_mm[wall.triangles]
        self._centres_mm = corners.mean(axis=1)
        self._lift_mm = LIFT * float(np.ptp(self._centres_mm, axis=0).max())
        self._normals = unit(wall.doubled_area).astype(np.float32)
        self._area = area = np.sqrt((wall.doubled_area**2).sum(axis=1)) / 2
        self._triangles = self._of_blocks()
        share = area[self._triangles]
        self.area_mm2 = share.sum(axis=1)
        self._share = (share / np.maximum(self.area_mm2[:, None], 1e-20)).astype(np.float32)
        self.patch_of = np.empty(len(area), np.int64)
        self.patch_of[self._triangles] = np.arange(len(self._triangles))[:, None]
        self.form_factors = self._counted(corners, rng)
        rows, columns = np.divmod(np.arange(len(area)) // 2, wall.shape[1])
        scale = (tissue.shape[0] - 1) / (wall.shape[0] - 1)
        texels = sampled(tissue, scale * np.stack([rows + 0.5, columns + 0.5], axis=1))
        self.tissue = self._mean(texels).astype(np.float32)

    def direct(self, lamp: Lamp, pose: np.ndarray) -> np.ndarray:
        """Irradiance float32 [P] that the lamp of a camera at ``pose`` [4, 4] throws on the patches."""
        total = np.zeros(len(self._centres_mm))
        for triangles, irradiance, _ in self._lit(lamp, pose):
            total[triangles] += irradiance
        return self._mean(total[:, None])[:, 0].astype(np.float32)

    def mirrored(
        self, lamp: Lamp, pose: np.ndarray, roughness: np.ndarray, f0: float, rng: np.random.Generator
    ) -> np.ndarray:
        """Irradiance float32 [P] of that lamp's light where facets of patches of ``roughness`` [P] mirror it:
        each triangle's flux follows a few of its facets, drawn by their visible share."""
        flux = np.zeros(len(self._triangles))
        for triangles, irradiance, to_light in self._lit(lamp, pose):
            each, met, share = self._by_facets(triangles, to_light, roughness, f0, rng)
            sent = share * (irradiance * self._area[triangles])[each]
            flux += np.bincount(met, sent, len(flux))
        return (flux / self.area_mm2).astype(np.float32)

    def shown(
        self, pose: np.ndarray, lobes: list[tuple[float, float, np.ndarray]], rng: np.random.Generator
    ) -> scipy.sparse.csr_array:
        """CSR [P, P], means over what facets of patches mirror to a camera at ``pose`` [4, 4]: those of the
        ``lobes``, of reflectance f0, weight and roughness [P]. A row is empty where the camera sees none."""
        parts = []
        for triangles, _, to_eye in self._lit(Lamp(L0=1, n=0, q=0), pose):
            for f0, weight, roughness in lobes:
                each, met, share = self._by_facets(triangles, to_eye, roughness, f0, rng)
                seen = triangles[each]
                parts.append((self.patch_of[seen], met, weight * share * self._area[seen]))
        row, column, share = map(np.concatenate, zip(*parts, strict=True))
        share = share / np.bincount(row, share, len(self._triangles))[row]
        shape = (len(self._triangles),) * 2
        return scipy.sparse.coo_array((share.astype(np.float32), (row, column)), shape=shape).tocsr()

    def _by_facets(
        self,
        triangles: np.ndarray,
        to_end: np.ndarray,
        roughness: np.ndarray,
        f0: float,
        rng: np.random.Generator,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Ways from directions ``to_end`` [N, 3] of triangles [N] by FACETS facets of each to other patches:
        which of the N, the patch, and its share of what lobes of ``roughness`` [P] reflect."""
        each = np.repeat(np.arange(len(triangles)), FACETS)
        normals, draw = self._normals[triangles][each], rng.random((len(each), 2))
        rough = roughness[self.patch_of[triangles]][each]
        out, share = reflected(normals, to_end[each], rough, f0, draw[:, 0], draw[:, 1])
        hit = self._wall.hit_triangle(self._centres_mm[triangles][each] + self._lift_mm * normals, out)
        landed = (hit >= 0) & (share > 0)
        return each[landed], self.patch_of[hit[landed]], share[landed] / FACETS

    def bounce(
        self,
        direct: np.ndarray,
        color: np.ndarray,
        glossy: np.ndarray,
        mirrored: np.ndarray,
        shown: list[scipy.sparse.csr_array] | None = None,
    ) -> Bounce:
        """All light between patches [P] for direct irradiance [P, F], of which ``mirrored`` [P, F] is what
        white lobes throw on; they send ``glossy`` [P] of all other light back, and diffuse ones ``color``
        [P, 3]. What so leaves patches is ``shown`` to F cameras; by default they are shown what arrives."""
        color, direct = color[:, None].astype(np.float32), direct[..., None]
        albedo = color + glossy[:, None, None].astype(np.float32)
        arriving = np.zeros(np.broadcast_shapes(color.shape, direct.shape), np.float32)
        for _ in range(MOST_BOUNCES):
            leaving = color * direct + albedo * arriving
            before = arriving
            met = self.form_factors @ leaving.reshape(len(direct), -1)
            arriving = met.reshape(arriving.shape) + mirrored[..., None]
            if np.abs(arriving - before).max() <= CONVERGED * arriving.max():
                break
        views = arriving.copy()
        for frame, mixture in enumerate(shown or ()):
            seen = np.diff(mixture.indptr) > 0
            views[seen, frame] = (mixture @ leaving[:, frame])[seen]
        return Bounce(*(np.moveaxis(x, 1, 0).reshape(-1, *self.shape, 3) for x in (arriving, views)))

    def _lit(self, lamp: Lamp, pose: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Of each guide the triangles int [N] that it lights, their irradiance [N] and directions [N, 3] to
        it."""
        rotation, centre = pose[:3, :3], pose[:3, 3]
        points_mm = (self._centres_mm - centre) @ rotation
        normals = self._normals @ rotation
        for guide, guide_mm in enumerate(lamp.guides_mm):
            strength, to_light = lamp.arriving(guide, points_mm)
            strength = strength * np.maximum(dot(normals, to_light), 0)
            lit = np.flatnonzero(strength > 0)
            source_mm = centre + rotation @ np.asarray(guide_mm)
            lit = lit[self._wall.sees(source_mm, self._centres_mm[lit])]
            yield lit, strength[lit], to_light[lit] @ rotation.T

    def _of_blocks(self) -> np.ndarray:
        """Triangles int [P, 2·BLOCK²] of each patch."""
        quads = np.arange((self._wall.shape[0] - 1) * self._wall.shape[1])
        quads = quads.reshape(self.shape[0], BLOCK, self.shape[1], BLOCK).swapaxes(1, 2).reshape(-1, BLOCK**2)
        return np.concatenate([2 * quads, 2 * quads + 1], axis=1)

    def _mean(self, values: np.ndarray) -> np.ndarray:
        """Means [P, C] over the patches' areas of values [T, C] of triangles."""
        return np.einsum("pt,ptc->pc", self._share, values[self._triangles])

    def _counted(self, corners: np.ndarray, rng: np.random.Generator) -> scipy.sparse.csr_array:
        count, each = len(self._triangles), STRATA**2
        cell = np.stack(np.divmod(np.arange(each), STRATA), axis=1)
        member = np.arange(each) % self._triangles.shape[1]
        repeats = each / self._triangles.shape[1]
        parts = []
        for first in range(0, count, AT_ONCE):
            patches = np.arange(first, min(first + AT_ONCE, count))
            triangle = self._triangles[patches][:, member].ravel()
            weight = self._share[patches][:, member].ravel() / repeats
            draw = rng.random((len(patches), each, 4), np.float32)
            draw[..., :2] = (cell + draw[..., :2]) / STRATA
            draw = draw.reshape(-1, 4)
            normal = self._normals[triangle]
            direction = cosine_weighted(normal, draw[:, 0], draw[:, 1])
            origin = inside(corners[triangle], draw[:, 2], draw[:, 3]) + self._lift_mm * normal
            hit = self._wall.hit_triangle(origin, direction)
            landed = np.flatnonzero(hit >= 0)
            place = (np.repeat(patches - first, each)[landed], self.patch_of[hit[landed]])
            part = scipy.sparse.coo_array((weight[landed], place), shape=(len(patches), count))
            parts.append(part.tocsr())
        return scipy.sparse.vstack(parts, format="csr")


def cosine_weighted(normals: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Directions [N, 3] about unit normals with density cosθ/π for u, v in [0, 1): Malley's method."""
    return about(normals, np.sqrt(1 - u), v)


def inside(corners: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Points [N, 3] spread evenly over triangles [N, 3, 3] for u, v in [0, 1) (Turk 1990)."""
    root = np.sqrt(u)[:, None]
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    return (1 - root) * a + root * (1 - v[:, None]) * b + root * v[:, None] * c

"""The shape of one polyp: a disc of the wall goes to a surface of revolution, made uneven by chance.

A point of the disc at the distance ρ from the axis goes to the point of the outline, r from the axis, where
dρ/ρ = ds/r, s along the outline: the map keeps angles, so that triangles keep their form, however long the
stalk. At ρ = R the outline lies on the wall, and goes on in it smoothly.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import BSpline, CubicSpline
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist

from endotwin.anatomy.classes import CLASSES, ParisClass
from endotwin.surface.vectors import dot

DEGREE = 3
STATIONS = 600
"""Points of the outline."""

LOBES = {2: 0.05, 3: 0.03, 4: 0.02, 5: 0.012}
"""Greatest swing of the outline seen from above, by lobes around, as a share of its width."""

BUMPS = 0.04
"""Greatest swing of bumps, as a share of their wavelength, by which a polyp of any size looks lobed alike."""

WAVES = 16
SHORTEST, LONGEST = 0.25, 0.8
"""Wavelengths of bumps, in sizes."""

LEAN = 0.22
"""Greatest shift of a stalk's top, in sizes."""

SOFT = 0.4
"""Share of a stalked polyp's height over which it leaves the wall's curvature."""


def smoothstep(x: np.ndarray) -> np.ndarray:
    """0 below 0, 1 above 1, smooth to the second derivative between them (Perlin 2002)."""
    x = np.clip(x, 0, 1)
    return x**3 * (x * (6 * x - 15) + 10)


def diameter(points: np.ndarray) -> float:
    """Greatest distance between two of the points [N, 2]."""
    return float(pdist(points[ConvexHull(points).vertices]).max())


@dataclass(frozen=True, eq=False)
class _Outline:
    """From the top to the wall.

    Attributes:
        log_t: float64 [K], ln(ρ/R), ascending to 0. r, z: [K], distance from the axis and height, mm.
        edge, head: t where the polyp ends, and the part that its size is of.
    """

    log_t: np.ndarray
    r: np.ndarray
    z: np.ndarray
    edge: float
    head: float

    @classmethod
    def through(cls, points: np.ndarray, edge: int, head: int) -> _Outline:
        """The cubic spline of control points [P, 2]; ``edge`` and ``head``: numbers of two of them."""
        inner = np.linspace(0, 1, len(points) - DEGREE + 1)
        knots = np.r_[[0] * DEGREE, inner, [1] * DEGREE]
        u = np.linspace(0, 1, STATIONS)
        r, z = BSpline(knots, points, DEGREE)(u).T
        step = np.hypot(np.diff(r), np.diff(z))[1:]
        log_t = np.r_[0, np.cumsum((2 * step / (r[1:-1] + r[2:]))[::-1])][::-1] * -1.0
        # A control point has its greatest weight at the mean of the knots about it (Greville)
        ends = (np.interp(knots[k + 1 : k + 1 + DEGREE].mean(), u[1:], log_t) for k in (edge, head))
        return cls(log_t, r[1:], z[1:], *(float(np.exp(end)) for end in ends))

    @property
    def radius_mm(self) -> float:
        return float(self.r[-1])

    @cached_property
    def _spline(self) -> CubicSpline:
        return CubicSpline(self.log_t, np.stack([self.r, self.z], axis=1))

    def at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """r and z, [2, N], and their growth with ln t, [2, N]; the top, within the first station, is flat."""
        log_t = np.log(t)
        within = np.maximum(log_t, self.log_t[0])
        places, rates = self._spline(within).T, self._spline(within, 1).T
        flat = np.exp(log_t - within)
        return places * [flat, np.ones_like(flat)], rates


@dataclass(frozen=True, eq=False)
class Shape:
    """A polyp that is not yet on a wall.

    Attributes:
        kind: its class. size_mm: greatest diameter across the axis, of the head if it has a stalk.
        height_mm: above the wall; 0: its points stay where they are. lobes, phases: float64 [L], of the
            outline from above. waves: [W, 3] wave vectors, 1/mm, offsets: [W], of its bumps. lean_mm: [2],
            shift of the top.
    """

    kind: str
    size_mm: float
    height_mm: float
    lobes: np.ndarray
    phases: np.ndarray
    waves: np.ndarray
    offsets: np.ndarray
    lean_mm: np.ndarray

    @classmethod
    def drawn(cls, kind: str, size_mm: float, height_mm: float, generator: np.random.Generator) -> Shape:
        """One of the class, drawn by chance."""
        lobes = np.array(list(LOBES.values())) * generator.uniform(0.3, 1, len(LOBES))
        phases = generator.uniform(0, 2 * np.pi, len(LOBES))
        directions = generator.standard_normal((WAVES, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        lengths_mm = size_mm * np.geomspace(SHORTEST, LONGEST, WAVES)
        offsets = generator.uniform(0, 2 * np.pi, WAVES)
        angle, far = generator.uniform(0, 2 * np.pi), generator.uniform(0.2, 1) * CLASSES[kind].stalked
        lean_mm = LEAN * size_mm * far * np.array([np.cos(angle), np.sin(angle)])
        waves = 2 * np.pi * directions / lengths_mm[:, None]
        return cls(kind, size_mm, height_mm, lobes, phases, waves, offsets, lean_mm)

    @property
    def paris(self) -> ParisClass:
        return CLASSES[self.kind]

    @cached_property
    def _outline(self) -> _Outline:
        points = np.array(self.paris.outline) * [self.size_mm / 2, self.height_mm]
        return _Outline.through(points, self.paris.edge, self.paris.head)

    @property
    def radius_mm(self) -> float:
        """R, of the disc of wall that becomes the polyp and what joins it to the wall."""
        return self._outline.radius_mm

    @property
    def edge(self) -> float:
        """The t at which the polyp ends."""
        return self._outline.edge

    @property
    def head(self) -> float:
        """The t at which the part ends that the size is of."""
        return self._outline.head

    @property
    def flat(self) -> bool:
        """Whether it has a colour only."""
        return self.height_mm == 0

    @property
    def magnified(self) -> float:
        """How many times longer an edge becomes at the top."""
        return self._outline.r[0] / (np.exp(self._outline.log_t[0]) * self.radius_mm)

    def rings(self, count: int, around: int, until: float) -> np.ndarray:
        """Points [count·around, 2] of the disc that go to rings about the axis, even along the outline, the
        last of them at t = ``until``."""
        log_t = self._outline.log_t
        last = np.searchsorted(log_t, np.log(until))
        t = np.exp(log_t[np.linspace(0, last, count).round().astype(int)])
        angle = 2 * np.pi * np.arange(around) / around
        turns = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return (self.radius_mm * t[:, None, None] * turns).reshape(-1, 2)

    def own(self, t: np.ndarray) -> np.ndarray:
        """How much of the polyp's own there is at t [N]: 1 up to its edge, 0 on the wall."""
        return 1 - smoothstep((t - self.edge) / (1 - self.edge))

    def t(self, across_mm: np.ndarray) -> np.ndarray:
        """Distance of the disc's points [N, 2] from the axis as a share of its radius, [N]; of the radius in
        the direction of each, where the polyp is flat: its outline has lobes though no point moves."""
        t = np.linalg.norm(across_mm, axis=1) / self.radius_mm
        return t / (self._wider * (1 + self._swing(across_mm))) if self.flat else t

    def at(self, across_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where the disc's points [N, 2] go: [N, 3] about the axis, mm, the wall being flat; and the wall's
        share [N] that its curvature has there."""
        points, soft = self._uneven(across_mm)
        t = np.linalg.norm(across_mm, axis=1) / self.radius_mm
        own = self.own(t)[:, None]
        points *= 1 + own * (self._fit - 1)
        return points + smoothstep(points[:, 2:] / self.height_mm) * [*self.lean_mm, 0], soft

    @cached_property
    def _fit(self) -> np.ndarray:
        """Factors [3] on the distance from the axis and on the height that make them what they are to be."""
        points, _ = self._uneven(self.rings(120, 180, self.head))
        wider = self.size_mm / diameter(points[:, :2])
        return np.array([wider, wider, self.height_mm / points[np.abs(points[:, 2]).argmax(), 2]])

    @cached_property
    def _wider(self) -> float:
        """Factor on the outline from above that makes it as wide as it is to be."""
        around = 360
        rim = self.rings(2, around, self.head)[-around:]
        return self.size_mm / diameter(rim * (1 + self._swing(rim))[:, None])

    def _swing(self, across_mm: np.ndarray) -> np.ndarray:
        """By which share of its width the outline is wider, [N], in the direction of points [N, 2]."""
        angle = np.arctan2(across_mm[:, 1], across_mm[:, 0])
        around = np.arange(2, 2 + len(self.lobes))
        return (self.lobes * np.cos(around * angle[:, None] - self.phases)).sum(axis=1)

    def _uneven(self, across_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What ``at`` gives, before its width is set and it leans."""
        rho = np.maximum(np.linalg.norm(across_mm, axis=1), np.finfo(float).tiny)
        t = np.minimum(rho / self.radius_mm, 1)
        (r, z), (dr, dz) = self._outline.at(t)
        towards = across_mm / rho[:, None]
        swing = self._swing(across_mm)
        own = self.own(t)
        points = np.c_[(r * (1 + own * swing))[:, None] * towards, z]
        facing = np.c_[-dz[:, None] * towards, dr] / np.maximum(np.hypot(dr, dz), 1e-9)[:, None]
        points += (own * self._bumps_mm(points))[:, None] * facing
        soft = smoothstep(1 - z / (SOFT * self.height_mm)) if self.paris.stalked else np.ones(len(z))
        return points, soft

    def mottling(self, points_mm: np.ndarray) -> np.ndarray:
        """An uneven pattern at points [N, 3] of the polyp, of mean 0 and standard deviation 1."""
        return np.sin(2 * points_mm @ self.waves.T + self.offsets) @ np.full(WAVES, np.sqrt(2 / WAVES))

    def _bumps_mm(self, points_mm: np.ndarray) -> np.ndarray:
        """Height of bumps [N] at points [N, 3]."""
        length_mm = 2 * np.pi / np.sqrt(dot(self.waves, self.waves))
        swings = np.cos(points_mm @ self.waves.T + self.offsets)
        return self.paris.bumps * BUMPS / np.sqrt(len(length_mm)) * swings @ length_mm

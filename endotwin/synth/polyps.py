"""Polyps that are asked for by their Paris class, and where they stand."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
import scipy.sparse

from endotwin.anatomy import CLASSES, Seedling, Site, grown
from endotwin.anatomy.shape import Shape
from endotwin.cameras import Camera
from endotwin.errors import OptionError
from endotwin.run.streams import Stream
from endotwin.surface.casting import Caster
from endotwin.surface.vectors import dot
from endotwin.synth.trajectories import Trajectory
from endotwin.synth.trajectories.trajectory import parse_options
from endotwin.synth.wall import Several, Wall, one_by_one
from endotwin.twin import Twin
from endotwin.twin.polyps import MOST_POLYPS

SMALLEST_MM, LARGEST_MM = 1.0, 50.0

TRIES = 400
"""Places that are tried for one polyp."""


@dataclass(frozen=True)
class PolypOptions(Several):
    """Options of a polyp of any class."""

    size: float = field(default=6.0, metadata={"help": "greatest diameter, of the head of a stalk, mm"})
    height: float = field(
        default=0.0, metadata={"help": "above the wall, mm; 0: the class's usual one", "signed": True}
    )
    ihb: float = field(
        default=2.9, metadata={"help": "index of haemoglobin above that of the wall", "signed": True}
    )


def with_polyps(
    twin: Twin,
    specs: Iterable[str] | str,
    seed: int,
    trajectory: Trajectory | None = None,
    camera: Camera | None = None,
) -> tuple[Twin, scipy.sparse.csr_array]:
    """The fitted twin with polyps, and the weights CSR [W, V] of its old vertices in the new ones.

    Args:
        specs: ``CLASS:NAME=VALUE,…`` of classes among ``anatomy.CLASSES``, one or several.
        seed: of shapes, and of places that are not given. trajectory: that sees these, and keeps its
            clearance from them; None: wherever training photos saw the wall. camera: that it looks through.

    Raises:
        TwinError: the twin is not fitted. OptionError: a polyp is not understood, or does not fit.
    """
    if twin.fluids:
        raise OptionError("fluids lie on this twin already; grow polyps on the one without them")
    full = f"a twin holds {MOST_POLYPS} polyps at most; ask for fewer"
    each = one_by_one(twin, specs, parse_polyp, MOST_POLYPS - len(twin.polyps), full, "polyps")
    garden = _Garden(twin, trajectory, camera or twin.camera)
    seedlings = [
        garden.seedling(*one, Stream.POLYP.generator(seed, k)) for k, one in enumerate(each, len(twin.polyps))
    ]
    return grown(twin, seedlings)


def parse_polyp(spec: str) -> tuple[str, PolypOptions]:
    """The class and the options of ``CLASS:NAME=VALUE,…``; raises OptionError."""
    kind, _, text = spec.partition(":")
    if kind not in CLASSES:
        raise OptionError(
            f"polyp {spec!r} is of no known class; write {' or '.join(CLASSES)}, with :NAME=VALUE,…"
        )
    options = parse_options(spec, text, PolypOptions, "polyp", OptionError)
    if not SMALLEST_MM <= options.size <= LARGEST_MM:
        raise OptionError(f"polyp {spec!r}: its size lies between {SMALLEST_MM:g} and {LARGEST_MM:g} mm")
    low, high = CLASSES[kind].height_range_mm(options.size)
    if low > high:
        raise OptionError(f"polyp {spec!r}: {kind} is higher than {low:g} mm, and so no smaller than that")
    if options.height and not low <= options.height <= high:
        raise OptionError(
            f"polyp {spec!r}: {kind} of {options.size:g} mm is {low:g} to {high:g} mm high (Paris classes)"
        )
    options.require_count(f"polyp {spec!r}")
    return kind, options


class _Garden:
    """The wall of one twin, and the places on it that are taken."""

    def __init__(self, twin: Twin, trajectory: Trajectory | None, camera: Camera):
        self._twin, self._trajectory = twin, trajectory
        self._caster = Caster(twin.surface)
        self._taken = [
            (np.array(polyp.place_mm) - twin.surface.origin_mm, CLASSES[polyp.kind].radius_mm(polyp.size_mm))
            for polyp in twin.polyps
        ]
        self._wall = Wall(twin, trajectory, camera, self._caster)

    def seedling(
        self, spec: str, kind: str, options: PolypOptions, generator: np.random.Generator
    ) -> Seedling:
        """One polyp at a place that suits it, which is taken then."""
        height_mm = options.height or CLASSES[kind].usual_height_mm(options.size)
        shape = Shape.drawn(kind, options.size, height_mm, generator)
        fault = "no wall is seen"
        places = self._wall.places(f"polyp {spec!r}", options, generator)
        for point, normal in islice(places, TRIES):
            site = Site.at(point, normal, shape.radius_mm, self._caster)
            fault = self._fault(shape, site, options.placed)
            if not fault:
                self._taken.append((site.foot_mm, shape.radius_mm))
                return Seedling(shape, site, options.ihb)
        if options.placed:
            raise OptionError(f"polyp {spec!r} cannot grow: {fault}; choose another place, or a smaller size")
        raise OptionError(
            f"polyp {spec!r}: of the wall that is seen, no place that was tried holds it (at the last one, "
            f"{fault}); choose a smaller size or count, or a place"
        )

    def _fault(self, shape: Shape, site: Site, placed: bool) -> str:
        """What hinders the shape from growing at the site, as the end of a sentence."""
        for foot_mm, radius_mm in self._taken:
            if np.linalg.norm(site.foot_mm - foot_mm) < shape.radius_mm + radius_mm:
                return "another polyp stands there"
        fault = site.fault(shape, self._caster)
        if fault or placed or self._trajectory is None:
            return fault
        limits = self._trajectory.limits
        clear_mm = shape.size_mm / 2 + (limits.clearance_mm if limits else 0.0)
        cameras = self._trajectory.T_world_camera[:, :3, 3] - self._twin.surface.origin_mm
        local = site.within(cameras)
        local[:, 2] -= np.clip(local[:, 2], 0, max(shape.height_mm, 0))
        near = dot(local, local) < clear_mm**2
        return "a pose of the trajectory is too near to it" if near.any() else ""

"""Fluids that are asked for by name, and where they lie."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
import scipy.sparse
from scipy.spatial import cKDTree

from endotwin.anatomy.optics import MUCUS, STOOL, WHOLE_BLOOD, Optics, blood
from endotwin.anatomy.wet import Puddle, Wetted, hollows_mm
from endotwin.cameras import Camera
from endotwin.errors import OptionError
from endotwin.run.streams import Stream
from endotwin.surface.casting import Caster
from endotwin.surface.vectors import unit
from endotwin.synth.trajectories import Trajectory
from endotwin.synth.trajectories.trajectory import parse_options
from endotwin.synth.wall import Several, Wall, one_by_one
from endotwin.twin import Twin
from endotwin.twin.fluids import MOST_FLUIDS

SMALLEST_MM, LARGEST_MM = 2.0, 60.0
THINNEST_MM = 0.01

POOL_MM = 2.5
"""Depth of a pool unless another is asked for."""

TRIES = 30
"""Places that are tried for one patch."""

HOLLOW_MM = 0.3
"""Depth to which a place must hold fluid for a pool that is put there by chance."""


@dataclass(frozen=True)
class FluidKind:
    """One fluid: how it adheres (see ``anatomy.spread.SPREADS``), how thick it is then, mm, and how thick it
    may be; its optics."""

    spread: str
    usual_mm: float
    most_mm: float
    optics: Optics


FLUIDS = {
    "blood": FluidKind("film", 0.25, 1.0, blood(WHOLE_BLOOD)),
    "mucus": FluidKind("strands", 0.4, 1.0, MUCUS),
    "stool": FluidKind("lumps", 1.2, 4.0, STOOL),
}
"""By name."""


@dataclass(frozen=True)
class FluidOptions(Several):
    """Options of any fluid."""

    size: float = field(default=10.0, metadata={"help": "greatest extent along the wall, mm"})
    thickness: float = field(
        default=0.0, metadata={"help": "greatest, of a pool its depth, mm; 0: the usual one"}
    )
    pool: bool = field(default=False, metadata={"help": "whether it stands level in a hollow"})
    haemoglobin: float = field(default=WHOLE_BLOOD, metadata={"help": "of blood, g/L: less where diluted"})
    gx: float = field(default=0.0, metadata={"help": "way that gravity pulls, world axes", "signed": True})
    gy: float = field(default=0.0, metadata={"help": "way that gravity pulls, world axes", "signed": True})
    gz: float = field(default=0.0, metadata={"help": "way that gravity pulls, world axes", "signed": True})

    def down(self, trajectory: Trajectory | None) -> np.ndarray:
        """Unit vector [3] along gravity, world axes: as given, or else towards the lower edge of what the
        trajectory sees, in the mean; y where there is none."""
        given = np.array([self.gx, self.gy, self.gz])
        if given.any():
            return unit(given)
        mean = np.array([0.0, 1.0, 0.0])
        if trajectory is not None:
            mean = trajectory.T_world_camera[:, :3, 1].mean(axis=0)
        return unit(mean) if np.linalg.norm(mean) > 1e-6 else np.array([0.0, 1.0, 0.0])


def with_fluids(
    twin: Twin,
    specs: Iterable[str] | str,
    seed: int,
    trajectory: Trajectory | None = None,
    camera: Camera | None = None,
) -> tuple[Twin, scipy.sparse.csr_array]:
    """The fitted twin with fluids on its wall, and the weights CSR [W, V] of its old vertices in the new.

    Args:
        specs: ``KIND:NAME=VALUE,…`` of kinds among ``FLUIDS``, one or several.
        seed: of shapes, and of places that are not given. trajectory: that sees these; None: wherever
            training photos saw the wall. camera: that it looks through.

    Raises:
        TwinError: the twin is not fitted. OptionError: a fluid is not understood, or finds no place.
    """
    full = f"{MOST_FLUIDS} patches of fluid lie on a twin at most; ask for fewer"
    each = one_by_one(twin, specs, parse_fluid, MOST_FLUIDS - len(twin.fluids), full, "fluids")
    wall, wetted = Wall(twin, trajectory, camera or twin.camera, Caster(twin.surface)), Wetted(twin)
    for k, one in enumerate(each, len(twin.fluids)):
        _spill(wetted, wall, one[2].down(trajectory), *one, Stream.FLUID.generator(seed, k))
    return wetted.finished(), wetted.weights


def parse_fluid(spec: str) -> tuple[str, FluidOptions]:
    """The kind and the options of ``KIND:NAME=VALUE,…``; raises OptionError."""
    kind, _, text = spec.partition(":")
    if kind not in FLUIDS:
        raise OptionError(
            f"fluid {spec!r} is of no known kind; write {' or '.join(FLUIDS)}, with :NAME=VALUE,…"
        )
    options = parse_options(spec, text, FluidOptions, "fluid", OptionError)
    if not SMALLEST_MM <= options.size <= LARGEST_MM:
        raise OptionError(f"fluid {spec!r}: its size lies between {SMALLEST_MM:g} and {LARGEST_MM:g} mm")
    most_mm = options.size / 2 if options.pool else FLUIDS[kind].most_mm
    if options.thickness and not THINNEST_MM <= options.thickness <= most_mm:
        raise OptionError(f"fluid {spec!r}: its thickness lies between {THINNEST_MM:g} and {most_mm:g} mm")
    options.require_count(f"fluid {spec!r}")
    if options.haemoglobin != WHOLE_BLOOD and kind != "blood":
        raise OptionError(f"fluid {spec!r}: only blood has haemoglobin")
    return kind, options


def _spill(
    wetted: Wetted,
    wall: Wall,
    down: np.ndarray,
    spec: str,
    kind: str,
    options: FluidOptions,
    generator: np.random.Generator,
) -> None:
    """Let one patch lie on the wall, at a place that suits it."""
    found = FLUIDS[kind]
    shape = int(generator.integers(2**63))
    fault, tried = "no such wall is seen", 0
    if options.pool and not options.placed:
        fault = "no hollow of what is seen holds any as gravity pulls (gx, gy and gz say which way)"
    for point in _places(wall, wetted.twin, f"fluid {spec!r}", options, down, generator):
        puddle = Puddle(
            kind,
            found.optics if kind != "blood" else blood(options.haemoglobin),
            "pool" if options.pool else found.spread,
            options.size,
            options.thickness or (min(POOL_MM, options.size / 2) if options.pool else found.usual_mm),
            down,
            point,
            np.random.default_rng(shape),
        )
        fault, tried = wetted.add(puddle), tried + 1
        if not fault:
            return
    where = "there" if options.placed else f"at any of {tried} places" if tried else "anywhere"
    raise OptionError(f"fluid {spec!r} cannot lie {where}: {fault}; choose another place, or a smaller size")


def _places(
    wall: Wall,
    twin: Twin,
    what: str,
    options: FluidOptions,
    down: np.ndarray,
    generator: np.random.Generator,
) -> Iterator[np.ndarray]:
    """Points [3] of the wall to try, in the surface's frame: of a pool without a place, in hollows."""
    points = (point for point, _ in wall.places(what, options, generator))
    if options.pool and not options.placed:
        deep = hollows_mm(twin.surface, down) > HOLLOW_MM
        nearest = cKDTree(twin.surface.vertices_mm)
        points = (point for point in points if deep[nearest.query(point)[1]])
    return islice(points, TRIES)

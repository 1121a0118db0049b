"""The surface of a twin at any time, and a trajectory through it: what was asked for, and if it can be."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from endotwin.errors import OptionError, TrajectoryError
from endotwin.run.arguments import texts
from endotwin.surface import Surface
from endotwin.synth.motion.crossing import crossings
from endotwin.synth.motion.kinds import KINDS, Breathing, Peristalsis
from endotwin.synth.motion.tube import Carried, Line, Places
from endotwin.synth.trajectories import Trajectory
from endotwin.synth.trajectories.centerline import find_centerline
from endotwin.synth.trajectories.lumen import Lumen
from endotwin.synth.trajectories.trajectory import parse_options
from endotwin.twin import Twin

log = logging.getLogger(__name__)

POSITIVE = ("width", "speed", "delay", "spacing", "period", "wavelength")

NARROWEST = 0.2
"""Least share of its radius that a contraction may leave of the lumen."""

PROBES = 8
"""Times at which the surface is searched for folds; at the worst of them, for triangles that cross."""

FLAWS, MORE = 1e-4, 1.1
"""Share of the vertices that may be folded, and of the triangles that may cross others, beside MORE of those
that do at rest: a fused mesh has slivers, and layers that nearly touch."""

NEAR = 3.0
"""Wall within so many radii of the lumen is searched for what is nearest to a camera."""

FEW, SLACK_MM = 5000, 1.0
"""Vertices, evenly chosen, that tell how much nearer to a camera tissue comes; and how much nearer others may
come still."""


@dataclass(frozen=True, eq=False)
class Motion:
    """How the tissue of one twin moves.

    Attributes:
        kinds: what moves it. rest: the surface at rest. line: its centreline. places: of its vertices.
    """

    kinds: tuple[Peristalsis | Breathing, ...]
    rest: Surface
    line: Line
    places: Places

    def to_dict(self) -> dict:
        """The options by name, for JSON."""
        names = {kind: name for name, kind in KINDS.items()}
        return {names[type(each)]: asdict(each) for each in self.kinds}

    def surface(self, time_s: float) -> Surface:
        """The surface at ``time_s``: vertices and normals of the one at rest as they are then."""
        shift, M = self._bent(time_s)
        vertices = self._vertices
        return replace(self.rest, vertices_mm=vertices.moved(shift, M), normals=vertices.turned(shift, M)[0])

    def carried(self, trajectory: Trajectory) -> Trajectory:
        """The trajectory on which the moving lumen takes the camera along, without the poses that its wall
        comes too near to.

        Raises:
            TrajectoryError: no pose is left. OptionError: the tissue would fold or cross itself.
        """
        self.require_sound(trajectory.timestamps_s)
        poses = trajectory.T_world_camera.copy()
        clearance_mm = np.empty(len(poses))
        for index, time_s in enumerate(trajectory.timestamps_s):
            poses[index], clearance_mm[index] = self._ridden(poses[index], time_s)
        least_mm = trajectory.limits.clearance_mm if trajectory.limits else 0.0
        kept = np.flatnonzero(clearance_mm >= least_mm)
        lost = len(poses) - len(kept)
        if not len(kept):
            raise TrajectoryError(
                f"the moving wall comes nearer than {least_mm:g} mm to all {lost} poses; lower the motion's "
                "amplitude, or --clearance"
            )
        if lost:
            log.warning(
                "%d of %d poses are dropped, which the moving wall comes too near to", lost, len(poses)
            )
        numbers = np.arange(len(poses)) if trajectory.numbers is None else trajectory.numbers
        checks = {**trajectory.checks, "clearance_mm": clearance_mm}
        counts = dict(trajectory.counts)
        if lost:
            counts["dropped"] = counts.get("dropped", 0) + lost
        return replace(
            trajectory,
            T_world_camera=poses[kept],
            timestamps_s=trajectory.timestamps_s[kept],
            numbers=numbers[kept],
            checks={name: values[kept] for name, values in checks.items()},
            counts=counts,
        )

    def require_sound(self, times_s: np.ndarray) -> None:
        """Raise OptionError where, at some of ``times_s`` [N], the surface is folded or crosses itself."""
        probed = np.unique(times_s[np.linspace(0, len(times_s) - 1, PROBES).round().astype(int)])
        far_mm = np.empty(len(probed))
        for k, time_s in enumerate(probed):
            narrowest = 1 - (self._contraction(time_s) / self.line.radius_mm).max()
            shift, M = self._bent(time_s)
            space = self._vertices.turned(shift, M)[1]
            if narrowest < NARROWEST or (space <= 0).mean() > FLAWS:
                raise OptionError(
                    f"motion folds the tissue at {time_s:.2f} s; lower its amplitude, or widen its waves"
                )
            moves = self._vertices.moved(shift, M) - self.rest.vertices_mm
            far_mm[k] = np.abs(moves - moves.mean(axis=0)).max()
        worst = float(probed[far_mm.argmax()])
        then, flaws = len(crossings(self.surface(worst))), FLAWS * len(self.rest.triangles)
        at_rest = len(crossings(self.rest)) if then > flaws else 0
        if then > MORE * at_rest + flaws:
            raise OptionError(
                f"motion makes {then} triangles cross others at {worst:.2f} s, where {at_rest} do at rest; "
                "lower its amplitude, or widen its waves"
            )

    def _contraction(self, time_s: float) -> np.ndarray:
        return sum(each.contraction_mm(self.line.s_mm, self.line.length_mm, time_s) for each in self.kinds)

    def _bent(self, time_s: float) -> tuple[np.ndarray, np.ndarray]:
        """The line's shift and turn at ``time_s``."""
        shift_mm = sum(each.shift_mm(self.line.s_mm, time_s) for each in self.kinds)
        return self.line.bent(self._contraction(time_s), shift_mm)

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.rest.vertices_mm)

    @cached_property
    def _vertices(self) -> Carried:
        return Carried(self.line, self.places, self.rest.vertices_mm, self.rest.normals)

    def __getstate__(self) -> dict:
        """What it was made of: what was found on the way is soon found again."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @cached_property
    def _few(self) -> tuple[np.ndarray, Carried]:
        """FEW of the vertices at rest, [F, 3], and as the tissue takes them along."""
        chosen = slice(None, None, max(len(self.rest.vertices_mm) // FEW, 1))
        points = self.rest.vertices_mm[chosen]
        return points, Carried(self.line, self.places[chosen], points)

    def _ridden(self, T_world_camera: np.ndarray, time_s: float) -> tuple[np.ndarray, float]:
        """The pose [4, 4] where the lumen takes it, and how far it is then from the nearest vertex, mm."""
        shift, M = self._bent(time_s)
        (centre,) = self.rest.to_local(T_world_camera[None])[:, :3, 3]
        follow = min((each.follow for each in self.kinds if isinstance(each, Breathing)), default=0.0)
        place = Places.of(self.line, centre[None])
        turn = place.of_table(M / np.cbrt(np.linalg.det(M))[:, None, None])[0]
        to = centre + place.of_table(shift)[0] + (turn - np.eye(3)) @ place.across[0]
        pose = T_world_camera.copy()
        pose[:3, 3] += follow * (to - centre)
        turned_by = follow * Rotation.from_matrix(turn).as_rotvec()
        pose[:3, :3] = Rotation.from_rotvec(turned_by).as_matrix() @ pose[:3, :3]
        now = pose[:3, 3] - self.rest.origin_mm
        return pose, self._clearance_mm(centre, now, shift, M)

    def _clearance_mm(self, before: np.ndarray, now: np.ndarray, shift: np.ndarray, M: np.ndarray) -> float:
        """How far the nearest vertex, moved, is from ``now`` [3], where a camera is that was at ``before``;
        inf where the wall was far from there.

        Some vertices tell how far that is at most, and how much nearer tissue comes: what was farther away
        than both together is not the nearest.
        """
        points, carried = self._few
        rest_mm = np.linalg.norm(points - before, axis=1)
        near = np.flatnonzero(rest_mm < NEAR * np.median(self.line.radius_mm))
        if not len(near):
            return np.inf
        then_mm = np.linalg.norm(carried.moved(shift, M)[near] - now, axis=1)
        nearer_mm = max((rest_mm[near] - then_mm).max(), 0.0) + SLACK_MM
        asked = np.array(self._tree.query_ball_point(before, then_mm.min() + nearer_mm))
        wall = Carried(self.line, self.places[asked], self.rest.vertices_mm[asked]).moved(shift, M)
        return float(np.linalg.norm(wall - now, axis=1).min())


def parse_motion(specs: Iterable[str] | str, twin: Twin) -> Motion | None:
    """The motion of ``KIND:NAME=VALUE,…`` of kinds among ``KINDS``, one or several; None of none.

    Raises:
        OptionError: one is not understood. TrajectoryError: the twin has no centreline.
    """
    specs = texts("motion", specs)
    if not specs:
        return None
    kinds = [_parsed(spec) for spec in specs]
    if len({type(each) for each in kinds}) < len(kinds):
        raise OptionError(f"motion {', '.join(specs)}: give each kind once")
    centerline = find_centerline(Lumen(twin.surface))
    span_mm = float(np.ptp(twin.surface.vertices_mm, axis=0).max())
    line = Line.of(centerline, twin.surface, span_mm)
    places = Places.of(line, twin.surface.vertices_mm.astype(np.float64), twin.surface)
    return Motion(tuple(kinds), twin.surface, line, places)


def _parsed(spec: str) -> Peristalsis | Breathing:
    kind, _, text = spec.partition(":")
    if kind not in KINDS:
        raise OptionError(f"motion {spec!r} is no known kind; write {' or '.join(KINDS)}, with :NAME=VALUE,…")
    options = parse_options(spec, text, KINDS[kind], "motion", OptionError)
    for name in POSITIVE:
        if getattr(options, name, 1) <= 0:
            raise OptionError(f"motion {spec!r}: {name} must be greater than 0")
    if getattr(options, "follow", 0) > 1:
        raise OptionError(f"motion {spec!r}: follow lies between 0 and 1")
    return options

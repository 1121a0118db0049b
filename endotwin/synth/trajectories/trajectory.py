"""Trajectories for new views: from a file, or by a recipe; every pose is judged before it is rendered."""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from endotwin.cameras import Camera
from endotwin.errors import EndotwinError, OptionError, TrajectoryError
from endotwin.run.streams import Stream
from endotwin.sequence.poses import as_poses, frame_times, read_poses
from endotwin.synth.trajectories.flight import MOST_FRAMES, FlightOptions, fly
from endotwin.synth.trajectories.keyframes import SplineOptions, spline_through
from endotwin.synth.trajectories.orbit import OrbitOptions, orbit
from endotwin.synth.trajectories.screening import Findings, Gate, Limits
from endotwin.twin import Twin

log = logging.getLogger(__name__)

REDRAWS = 200
"""Tries to move one pose at random before giving up."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses to render, all inside the lumen and within the limits.

    Attributes:
        T_world_camera: float64 [N, 4, 4], camera to world, mm.
        timestamps_s: float64 [N].
        description: where the poses come from, in words; the same for the same spec and twin.
        spec: what was asked for. numbers: int [N], of the poses before some were dropped.
        checks: what the gate found of each pose, float64 [N] by name.
        counts: of poses asked for, redrawn and dropped. limits: that they keep.
        successive: whether a camera goes from each pose to the next.
    """

    T_world_camera: np.ndarray
    timestamps_s: np.ndarray
    description: str
    spec: str = ""
    numbers: np.ndarray | None = None
    checks: dict[str, np.ndarray] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    limits: Limits | None = None
    successive: bool = True

    def __len__(self) -> int:
        return len(self.T_world_camera)

    @property
    def originals(self) -> np.ndarray:
        """``numbers``, by which is drawn what a pose is rendered with, whatever others are dropped."""
        return np.arange(len(self)) if self.numbers is None else self.numbers


@dataclass(frozen=True)
class JitterOptions:
    """Options of ``jitter:``, which moves and turns the sequence's poses at random (as Han & Wu 2025 do)."""

    frames: int = field(default=0, metadata={"help": "number of poses; 0: as many as the sequence has"})
    translation: float = field(default=2.0, metadata={"help": "farthest move, mm, in any direction"})
    rotation: float = field(default=10.0, metadata={"help": "largest turn, degrees, about any axis"})


KINDS = {
    "jitter": JitterOptions,
    "centerline": FlightOptions,
    "spline": SplineOptions,
    "orbit": OrbitOptions,
}


def parse_trajectory(
    spec: str | Path | np.ndarray,
    twin: Twin,
    seed: int,
    camera: Camera | None = None,
    limits: Limits | None = None,
) -> Trajectory:
    """The trajectory that ``spec`` names, in the twin's world frame; the same for the same seed.

    Args:
        spec: a pose file (C3VD ``pose.txt``, TUM trajectory, ``transforms.json``), or ``KIND:KEY=VALUE,…``
            with a kind among ``KINDS`` and the keys of its options; ``spline:FILE,…`` begins with a pose
            file. Or the poses themselves, [N, 4, 4].
        seed: of all that is drawn at random.
        camera: to look through; the twin's own unless given.
        limits: what each pose must keep. Random poses are drawn again until they do; others are dropped.

    Raises:
        TrajectoryError: ``spec`` is not understood, a file cannot be read or has a pose outside the surface,
        or
            no pose keeps the limits.
        SequenceError: the twin's sequence is needed, and that is gone.
        OptionError: ``limits`` are none.
    """
    if limits is not None and not isinstance(limits, Limits):
        raise OptionError(f"the limits are {limits!r}, but must be an endotwin.synth.Limits")
    made_up = not isinstance(spec, str | os.PathLike)
    poses, spec = (as_poses(spec), "an array") if made_up else (None, os.fspath(spec))
    kind, _, text = spec.partition(":")
    if not made_up and kind not in KINDS and not Path(spec).is_file():
        raise TrajectoryError(
            f"trajectory {spec!r} is neither a pose file nor a known kind; write {allowed_specs()}"
        )
    gate = Gate(twin, camera or twin.camera, limits or Limits())
    if made_up:
        return _given(poses, frame_times(len(poses)), spec, "poses of an array", gate)
    if kind not in KINDS:
        poses, timestamps_s = read_poses(spec)
        _warn_of_metres(spec, poses, twin)
        return _given(poses, timestamps_s, spec, f"poses of the file {Path(spec).name}", gate)
    if kind == "spline":
        name, _, text = text.partition(",")
        if not Path(name).is_file():
            raise TrajectoryError(
                f"trajectory {spec!r}: there is no file {name!r} of keyframes; give its name"
            )
    options = parse_options(spec, text, KINDS[kind])
    if kind == "jitter":
        return _jittered(spec, options, twin, gate, seed)
    if kind == "centerline":
        poses, description = fly(options, gate.lumen, gate.camera, seed, gate.limits.clearance_mm)
    elif kind == "spline":
        poses, description = spline_through(options, Path(name))
        spec = spec.replace(name, Path(name).name)
    else:
        poses, description = orbit(options, twin)
    return _kept(spec, poses, frame_times(len(poses)), description, gate, gate.judge(poses))


def kept_in(trajectory: Trajectory, twin: Twin, camera: Camera) -> Trajectory:
    """The poses that may be rendered in ``twin`` too, whose surface has changed since they were judged.

    Raises:
        TrajectoryError: none may.
    """
    gate, poses = Gate(twin, camera, trajectory.limits or Limits()), trajectory.T_world_camera
    words = (trajectory.spec, poses, trajectory.timestamps_s, trajectory.description)
    kept = _kept(*words, gate, gate.judge(poses))
    dropped = trajectory.counts.get("dropped", 0) + len(poses) - len(kept)
    counts = {**trajectory.counts, "dropped": dropped}
    return replace(
        kept, successive=trajectory.successive, numbers=trajectory.originals[kept.numbers], counts=counts
    )


def allowed_specs() -> str:
    """What may be written for a trajectory, in one line."""
    kinds = [
        f"'{kind}:{'FILE,' * (kind == 'spline')}{','.join(f'{f.name}=…' for f in fields(options))}'"
        for kind, options in KINDS.items()
    ]
    return f"the name of a pose file (C3VD pose.txt, TUM, transforms.json), {' or '.join(kinds)}"


VALUES = {int: int, float: float, bool: {"true": True, "false": False}.__getitem__}
"""How the value of an option is read, by its type."""

GREATEST = 1e7
"""Above any number of millimetres or degrees that makes sense; infinity and NaN fail too."""

IN_METRES = 2e-3
"""Of the surface's extent: a path in mm that is read in metres reaches less far."""


def parse_options(
    spec: str,
    text: str,
    options: type,
    what: str = "trajectory",
    error: type[EndotwinError] = TrajectoryError,
):
    """``KEY=VALUE,…`` as an instance of the dataclass ``options``; values at least 0 unless ``signed``.

    Raises:
        error: ``text``, a part of the ``spec`` of ``what``, is not understood.
    """
    known = {f.name: f for f in fields(options)}
    values: dict[str, float] = {}
    for item in filter(None, (part.strip() for part in text.split(","))):
        key, equals, value = (part.strip() for part in item.partition("="))
        if not equals or key not in known or key in values:
            raise error(
                f"{what} {spec!r}: {item!r} is not understood; write KEY=VALUE, each KEY once, "
                f"out of {', '.join(known)}"
            )
        try:
            values[key] = VALUES[type(known[key].default)](value)
        except (ValueError, KeyError):
            values[key] = float("nan")
        least = -GREATEST if known[key].metadata.get("signed") else 0
        most = MOST_FRAMES if key == "frames" else GREATEST
        if not least <= values[key] <= most:
            switch = isinstance(known[key].default, bool)
            range_ = "is true or false" if switch else f"lies between {least:g} and {most:g}"
            raise error(
                f"{what} {spec!r}: {value!r} is no value for {key} ({known[key].metadata['help']}), "
                f"which {range_}"
            )
    return options(**values)


def _warn_of_metres(spec: str, poses: np.ndarray, twin: Twin) -> None:
    """Warn of a path that is a point beside the surface, and would not be if its unit were metres."""
    span_mm = float(np.ptp(poses[:, :3, 3], axis=0).max())
    if 0 < span_mm < IN_METRES * float(np.ptp(twin.surface.vertices_mm, axis=0).max()):
        log.warning(
            "the poses of %s lie within %.2g mm of each other: if they are in metres, write them in mm",
            *(spec, span_mm),
        )


def _kept(
    spec: str, poses: np.ndarray, timestamps_s: np.ndarray, description: str, gate: Gate, findings: Findings
) -> Trajectory:
    """The poses that pass; raises TrajectoryError where none does."""
    kept = np.flatnonzero(findings.passes)
    counts = {"asked": len(poses), "redrawn": 0, "dropped": len(poses) - len(kept)}
    if not len(kept):
        fault = f": pose 0 {gate.fault(findings, 0)}" if len(poses) else ""
        raise TrajectoryError(f"trajectory {spec!r}: none of its {len(poses)} poses can be rendered{fault}")
    if counts["dropped"]:
        first = int(findings.passes.argmin())
        log.warning(
            "%d of %d poses are dropped: the first, pose %d, %s",
            counts["dropped"],
            len(poses),
            first,
            gate.fault(findings, first),
        )
    return Trajectory(
        poses[kept], timestamps_s[kept], description, spec, kept, findings.checks(kept), counts, gate.limits
    )


def _given(
    poses: np.ndarray, timestamps_s: np.ndarray, name: str, description: str, gate: Gate
) -> Trajectory:
    """The poses that were given, each of which must lie inside the surface."""
    findings = gate.judge(poses)
    outside = np.flatnonzero(~findings.outlook.inside)
    if len(outside):
        first = int(outside[0])
        others = f" ({len(outside)} of its {len(poses)} poses cannot be used)" if len(outside) > 1 else ""
        raise TrajectoryError(
            f"pose {first} of {name} {gate.fault(findings, first)}{others}; poses are camera-to-world, in "
            "mm, OpenCV axes, in the frame of the twin's sequence"
        )
    return _kept(Path(name).name, poses, timestamps_s, description, gate, findings)


def _jittered(spec: str, options: JitterOptions, twin: Twin, gate: Gate, seed: int) -> Trajectory:
    """The sequence's poses, in turn, each moved and turned at random until it passes."""
    recorded = twin.sequence().T_world_camera
    usable = recorded[gate.judge(recorded).outlook.inside]
    if len(usable) == 0:
        raise TrajectoryError(
            "no pose of the twin's sequence lies inside its surface, so none can be moved; use a pose file"
        )
    frames = options.frames or len(recorded)
    bases = usable[np.arange(frames) * len(usable) // frames]
    generators = [Stream.JITTER.generator(seed, index) for index in range(frames)]
    poses = np.stack([_moved(*each) for each in zip(bases, [options] * frames, generators, strict=True)])
    pending, redrawn = np.flatnonzero(~gate.judge(poses).passes), 0
    for _ in range(REDRAWS):
        if len(pending) == 0:
            break
        redrawn += len(pending)
        poses[pending] = [_moved(bases[i], options, generators[i]) for i in pending]
        pending = pending[~gate.judge(poses[pending]).passes]
    description = (
        f"the sequence's poses, each moved by up to {options.translation:g} mm and turned by up to "
        f"{options.rotation:g}° at random"
    )
    kept = _kept(spec, poses, frame_times(frames), description, gate, gate.judge(poses))
    return replace(kept, counts={**kept.counts, "redrawn": redrawn}, successive=False)


def _moved(T_world_camera: np.ndarray, options: JitterOptions, generator: np.random.Generator) -> np.ndarray:
    """The pose moved evenly within a ball, and turned about a random axis by an evenly drawn angle."""
    directions = generator.standard_normal((2, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    far, turn = generator.random(2)
    pose = T_world_camera.copy()
    pose[:3, 3] += options.translation * np.cbrt(far) * directions[0]
    turned = Rotation.from_rotvec(np.deg2rad(options.rotation) * turn * directions[1]).as_matrix()
    pose[:3, :3] = T_world_camera[:3, :3] @ turned
    return pose

"""Trajectories for new views: a pose file, the sequence's own poses moved at random, or along the lumen."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from endotwin.errors import TrajectoryError
from endotwin.poses import frame_times, read_poses
from endotwin.synth.flight import FlightOptions, fly
from endotwin.synth.lumen import Lumen
from endotwin.twin import Twin

REDRAWS = 200
"""Tries to move one pose at random before giving up."""


@dataclass(frozen=True)
class Trajectory:
    """Poses to render, all inside the lumen.

    Attributes:
        T_world_camera: float64 [N, 4, 4], camera to world, mm.
        timestamps_s: float64 [N].
        description: where the poses come from, in words; the same for the same spec and twin.
    """

    T_world_camera: np.ndarray
    timestamps_s: np.ndarray
    description: str

    def __len__(self) -> int:
        return len(self.T_world_camera)


@dataclass(frozen=True)
class JitterOptions:
    """Options of ``jitter:``, which moves and turns the sequence's poses at random (as Han & Wu 2025 do)."""

    frames: int = field(default=0, metadata={"help": "number of poses; 0: as many as the sequence has"})
    translation: float = field(default=2.0, metadata={"help": "farthest move, mm, in any direction"})
    rotation: float = field(default=10.0, metadata={"help": "largest turn, degrees, about any axis"})


KINDS = {"jitter": JitterOptions, "centerline": FlightOptions}


def parse_trajectory(spec: str, twin: Twin, seed: int) -> Trajectory:
    """The trajectory that ``spec`` names, in the twin's world frame; the same for the same seed.

    Args:
        spec: a pose file (C3VD ``pose.txt``, TUM trajectory, ``transforms.json``), or ``jitter:KEY=VALUE,…``
            (keys of JitterOptions), or ``centerline:KEY=VALUE,…`` (keys of FlightOptions).
        seed: of all that is drawn at random.

    Raises:
        TrajectoryError: ``spec`` is not understood, a file cannot be read, or a pose is outside the surface.
        SequenceError: ``jitter`` needs the twin's sequence, and that is gone.
    """
    kind, _, text = spec.partition(":")
    if kind in KINDS:
        options = _parse_options(spec, text, KINDS[kind])
        lumen = Lumen(twin.surface)
        if kind == "jitter":
            return _jittered(options, twin, lumen, seed)
        poses, description = fly(options, lumen, twin.camera, seed)
        return Trajectory(poses, frame_times(len(poses)), description)
    path = Path(spec)
    if not path.is_file():
        raise TrajectoryError(
            f"trajectory {spec!r} is neither a pose file nor a known kind; write {allowed_specs()}"
        )
    return _from_file(path, twin)


def allowed_specs() -> str:
    """What may be written for a trajectory, in one line."""
    kinds = [
        f"'{kind}:{','.join(f'{f.name}=…' for f in fields(options))}'" for kind, options in KINDS.items()
    ]
    return f"the name of a pose file (C3VD pose.txt, TUM, transforms.json), {' or '.join(kinds)}"


VALUES = {int: int, float: float, bool: {"true": True, "false": False}.__getitem__}
"""How the value of an option is read, by its type."""

GREATEST = 1e7
"""Above any number of frames, millimetres or degrees that makes sense; infinity and NaN fail too."""


def _parse_options(spec: str, text: str, options: type) -> JitterOptions | FlightOptions:
    """``KEY=VALUE,…`` as an instance of the dataclass ``options``."""
    known = {f.name: f for f in fields(options)}
    keys = "; ".join(f"{f.name} ({f.metadata['help']}; default {f.default})" for f in known.values())
    values: dict[str, float] = {}
    for item in filter(None, (part.strip() for part in text.split(","))):
        key, equals, value = (part.strip() for part in item.partition("="))
        if not equals or key not in known or key in values:
            raise TrajectoryError(
                f"trajectory {spec!r}: {item!r} is not understood; its keys, each once, are {keys}"
            )
        try:
            values[key] = VALUES[type(known[key].default)](value)
        except (ValueError, KeyError):
            values[key] = -1
        if not 0 <= values[key] <= GREATEST:
            raise TrajectoryError(
                f"trajectory {spec!r}: {value!r} is no value for {key}; its keys are {keys}"
            )
    return options(**values)


def _from_file(path: Path, twin: Twin) -> Trajectory:
    """The poses in a file, each of which must lie inside the surface."""
    poses, timestamps_s = read_poses(path)
    outlook = Lumen(twin.surface).outlook(twin.camera, poses)
    outside = np.flatnonzero(~outlook.inside)
    if len(outside):
        first = int(outside[0])
        others = f" ({len(outside)} of its {len(poses)} poses cannot be used)" if len(outside) > 1 else ""
        raise TrajectoryError(
            f"pose {first} of {path} {outlook.fault(first)}{others}; poses are camera-to-world, in mm, "
            "OpenCV axes, in the frame of the twin's sequence"
        )
    return Trajectory(poses, timestamps_s, f"poses of the file {path.name}")


def _jittered(options: JitterOptions, twin: Twin, lumen: Lumen, seed: int) -> Trajectory:
    """The sequence's poses, in turn, each moved and turned at random until it lies inside the surface."""
    recorded = twin.source.open().T_world_camera
    usable = recorded[lumen.outlook(twin.camera, recorded).inside]
    if len(usable) == 0:
        raise TrajectoryError(
            "no pose of the twin's sequence lies inside its surface, so none can be moved; use a pose file"
        )
    frames = options.frames or len(recorded)
    bases = usable[np.arange(frames) * len(usable) // frames]
    generators = [np.random.default_rng([seed, index]) for index in range(frames)]
    poses = np.empty((frames, 4, 4))
    pending = np.arange(frames)
    for _ in range(REDRAWS):
        drawn = np.stack([_moved(bases[i], options, generators[i]) for i in pending])
        inside = lumen.outlook(twin.camera, drawn).inside
        poses[pending[inside]] = drawn[inside]
        pending = pending[~inside]
        if len(pending) == 0:
            moved = f"moved by up to {options.translation:g} mm and turned by up to {options.rotation:g}°"
            return Trajectory(poses, frame_times(frames), f"the sequence's poses, each {moved} at random")
    raise TrajectoryError(
        f"{len(pending)} of {frames} poses found no place inside the surface in {REDRAWS} draws; "
        "use a smaller translation or rotation"
    )


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

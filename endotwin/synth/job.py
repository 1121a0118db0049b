"""All that decides the bytes of a dataset, in one object that can be sent to a worker."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, fields
from importlib.metadata import version

import numpy as np

from endotwin.cameras import Camera
from endotwin.sequence.spread import spread
from endotwin.synth.motion import Motion
from endotwin.synth.trajectories import Trajectory
from endotwin.synth.variation import Draw
from endotwin.synth.variation.regions import Region
from endotwin.twin import Twin

LIBRARIES = ("endotwin", "numpy", "torch", "embreex", "opencv-contrib-python-headless", "openexr", "tifffile")

THUMBNAILS = 24


@dataclass(frozen=True, eq=False)
class Job:
    """A dataset to render.

    Attributes:
        twin: fitted, before any edit. camera: of the frames.
        trajectory: a pose a frame. draws: edits of the twin, one a frame. regions: that the draws refer to.
        labels: names of labels. images: names of the images that they are written as. layout: its name.
        shard_frames: frames that are rendered, and counted as done, together: a clip, where they are
            recorded as a video.
        document: the content of ``dataset.json``. motion: of the tissue; None: it is still.
        gains: float [N], on the light of each frame, where the camera sets them itself; None: 1.
    """

    twin: Twin
    camera: Camera
    trajectory: Trajectory
    draws: tuple[Draw, ...]
    regions: tuple[Region, ...]
    labels: tuple[str, ...]
    images: tuple[str, ...]
    layout: str
    shard_frames: int
    document: dict
    motion: Motion | None = None
    gains: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.trajectory)

    @property
    def shards(self) -> int:
        return -(-len(self) // self.shard_frames)

    def shard(self, number: int) -> range:
        """Indices of the frames of one shard."""
        first = number * self.shard_frames
        return range(first, min(first + self.shard_frames, len(self)))

    @property
    def digits(self) -> int:
        """Of a frame's number in file names: all of one length, so that they sort."""
        return max(4, len(str(len(self) - 1)))

    @property
    def thumbnails(self) -> set[int]:
        """Indices of the frames that the datasheet shows."""
        return set(spread(len(self), THUMBNAILS).tolist())

    def digest(self) -> str:
        """SHA-256 of all that decides the bytes: equal for the same command on the same twin and versions."""
        digest = hashlib.sha256(json.dumps(self.document, sort_keys=True).encode())
        digest.update(np.ascontiguousarray(self.trajectory.T_world_camera).tobytes())
        digest.update(np.ascontiguousarray(self.trajectory.timestamps_s).tobytes())
        digest.update(repr((self.draws, self.shard_frames)).encode())
        for region in self.regions:
            digest.update(region.weight.tobytes())
        return digest.hexdigest()


def fingerprint(twin: Twin) -> str:
    """SHA-256 of all that frames depend on: surface, materials, camera, light, response, effects, polyps,
    fluids."""
    digest = hashlib.sha256(json.dumps(twin.effects.to_dict(), sort_keys=True).encode())
    parts = (twin.surface, twin.camera, twin.light, twin.response)
    digest.update(json.dumps([asdict(polyp) for polyp in twin.polyps]).encode() if twin.polyps else b"")
    digest.update(json.dumps([asdict(fluid) for fluid in twin.fluids]).encode() if twin.fluids else b"")
    values = [(field.name, getattr(part, field.name)) for part in parts for field in fields(part)]
    materials = twin.materials.arrays | twin.materials.constants
    for name, value in (*values, *materials.items()):
        array = np.ascontiguousarray(value)
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def versions(recorder: bool) -> dict[str, str]:
    """Of the libraries that decide the bytes, and of the video's ``recorder``."""
    return {library: version(library) for library in LIBRARIES + (("av",) if recorder else ())}

"""A dataset as it lies on disk, read by its own ``dataset.json`` and the words of its layout."""

from __future__ import annotations

import json
import tarfile
from functools import cached_property
from pathlib import Path

import numpy as np

from endotwin.cameras import camera_from_dict
from endotwin.errors import EndotwinError, SequenceError
from endotwin.run.jsontext import parsed
from endotwin.run.output import DATASET
from endotwin.synth.labels import LABELS
from endotwin.synth.layouts import LAYOUTS
from endotwin.synth.layouts.layout import Layout
from endotwin.synth.trajectories import Trajectory

RECORDS = "frames.jsonl"


class Written:
    """The images of a dataset, frame by frame.

    Attributes:
        folder: of the dataset. document: the content of ``dataset.json``. records: of ``frames.jsonl``.
        layout, camera, trajectory: that it was written with. images: names of the images of a frame.
    """

    def __init__(self, folder: Path, document: dict, records: list[dict]):
        self.folder, self.document, self.records = folder, document, records
        self.layout: Layout = LAYOUTS[document["format"]]
        self.camera = camera_from_dict(document["camera"], folder / DATASET)
        self.trajectory = Trajectory(
            np.array([record["T_world_camera"] for record in records], np.float64),
            np.array([record["timestamp_s"] for record in records], np.float64),
            document["trajectory"],
        )
        self.images = tuple(dict.fromkeys(image for label in document["labels"] for image in LABELS[label]))
        self._tar: tuple[int, tarfile.TarFile] | None = None

    @classmethod
    def open(cls, folder: Path | str) -> Written:
        """The dataset in ``folder``. Raises SequenceError where there is none, or not a whole one."""
        folder = Path(folder)
        try:
            document = parsed((folder / DATASET).read_text(encoding="utf-8"))
            return cls(folder, document, read_records(folder))
        except FileNotFoundError as error:
            name = Path(error.filename).name
            raise SequenceError(
                f"{folder} has no {name}: only a dataset of 'endotwin synth' has labels to check; name one"
            ) from error
        except EndotwinError:
            raise
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise SequenceError(
                f"{folder} does not tell in {DATASET} and {RECORDS} what it holds ({error}); render it again"
            ) from error

    def __len__(self) -> int:
        return len(self.trajectory)

    @property
    def moving(self) -> bool:
        """Whether the tissue moves by itself."""
        return "motion" in self.document

    @property
    def digits(self) -> int:
        """Of a frame's number in file names."""
        return max(4, len(str(len(self) - 1)))

    def has(self, *images: str) -> bool:
        """Whether it has all of these images."""
        return set(images) <= set(self.images)

    def step(self, image: str) -> float:
        """Between neighbouring values of the image's code; 0 of floats."""
        return self.layout.encoding(image).step

    def image(self, index: int, name: str) -> np.ndarray:
        """An image of frame ``index``. Raises SequenceError where its file is missing or damaged."""
        place = self.layout.file(self, index, name)
        try:
            content = self._packed(index, place) if self.layout.packed else (self.folder / place).read_bytes()
            image = self.layout.encoding(name).decode(content)
        except Exception as error:  # libraries raise whatever the wrong bytes lead them to
            raise SequenceError(
                f"{self.folder / place} is missing, or holds no {name}; render the dataset again"
            ) from error
        if name != "vertices" and image.shape[:2] != (self.camera.height, self.camera.width):
            raise SequenceError(f"{self.folder / place} has the shape {image.shape[:2]}, unlike its camera")
        return image

    @cached_property
    def rays(self) -> np.ndarray:
        """Unit viewing direction of every pixel, float64 [H, W, 3]; NaN where the lens sees nothing."""
        u, v = np.meshgrid(np.arange(self.camera.width), np.arange(self.camera.height))
        return self.camera.directions(np.stack([u, v], axis=-1).astype(np.float64))

    @cached_property
    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices float64 [V, 3], world, mm, and triangles [F, 3] of ``surface.ply``."""
        import trimesh

        mesh = trimesh.load(self.folder / "surface.ply", process=False)
        return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)

    def _packed(self, index: int, place: str) -> bytes:
        """The file ``place`` of a frame, out of its tar; the tar read last stays open."""
        number = index // self.layout.shard_frames
        if self._tar is None or self._tar[0] != number:
            self.close()
            self._tar = number, tarfile.open(self.folder / f"shard-{number:04d}.tar")  # noqa: SIM115
        return self._tar[1].extractfile(place).read()

    def close(self) -> None:
        """Close the tar that is open."""
        if self._tar is not None:
            self._tar[1].close()
        self._tar = None


def read_records(folder: Path) -> list[dict]:
    """The lines of ``frames.jsonl``."""
    return [json.loads(line) for line in (folder / RECORDS).read_text(encoding="utf-8").splitlines()]

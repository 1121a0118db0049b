"""What every layout is: names for the images of a frame, and the tables beside them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from endotwin.cameras import Camera
from endotwin.synth.encodings import ENCODINGS, Encoding
from endotwin.synth.job import Job

FOLDER_SHARD = 16
"""Frames of a shard where each image is a file of its own: little is lost when a run stops."""


@dataclass(frozen=True)
class Layout:
    """A way to lay a dataset out on disk.

    Attributes:
        name: what ``--layout`` calls it.
        place: the path of an image within the dataset, from the job, the frame's index, the image's name and
        the
            suffix of its encoding.
        tables: writes poses, intrinsics and lists into the dataset's folder.
        words: what each table holds and which frames and units it uses.
        encodings: of images that this layout writes in another way.
        refusal: why a camera or a choice of labels does not fit, as a sentence; empty where it does.
        packed: whether a shard is one tar file.
        reads: whether endotwin reads it back. root: the folder within the dataset that it reads.
        advice: what another program must be told to read it.
        by_time: whether frames are named by their times.
    """

    name: str
    place: Callable[[Job, int, str, str], str]
    tables: Callable[[Path, Job], None]
    words: Mapping[str, str]
    encodings: Mapping[str, Encoding] = field(default_factory=dict)
    refusal: Callable[[Camera, tuple[str, ...]], str] = lambda camera, labels: ""
    packed: bool = False
    shard_frames: int = FOLDER_SHARD
    reads: bool = True
    root: str = "."
    advice: str = ""
    by_time: bool = False

    def encoding(self, image: str) -> Encoding:
        """How ``image`` is written."""
        return self.encodings.get(image, ENCODINGS[image])

    def file(self, job: Job, index: int, image: str) -> str:
        """The path of an image within the dataset."""
        return self.place(job, index, image, self.encoding(image).suffix)


def needs(*required: str) -> Callable[[Camera, tuple[str, ...]], str]:
    """A refusal of jobs that lack one of the ``required`` labels."""

    def refusal(camera: Camera, labels: tuple[str, ...]) -> str:
        missing = [label for label in required if label not in labels]
        return f"this layout needs {' and '.join(missing)}; add it to the labels" if missing else ""

    return refusal


def frame_name(job: Job, index: int) -> str:
    """The frame's number, all of one length."""
    return f"{index:0{job.digits}d}"


def in_folders(names: Mapping[str, str]) -> Callable[[Job, int, str, str], str]:
    """Places of images in a folder each, called as in ``names``, or else as the image is."""
    return lambda job, index, image, suffix: f"{names.get(image, image)}/{frame_name(job, index)}{suffix}"


def write_lines(path: Path, lines: list[str]) -> None:
    """A text file of ``lines``."""
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")


def numbers(values: np.ndarray) -> str:
    """Values separated by spaces, in digits that read back to the same float64."""
    return " ".join(repr(float(value)) for value in values)


CAMERA_WORDS = (
    "camera.json: camera model and intrinsics in pixels; pixel centres at whole numbers; camera axes x "
    "right, "
    "y down, z forward (OpenCV)"
)

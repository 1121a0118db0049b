"""A shard: frames that are rendered, written and counted as done together."""

from __future__ import annotations

import json
import os
import tarfile
from io import BytesIO
from pathlib import Path

from endotwin.effects.video import Clip
from endotwin.synth.job import Job
from endotwin.synth.labels import Labeller
from endotwin.synth.layouts import LAYOUTS
from endotwin.synth.run.statistics import Statistics

DATA, DONE = "data", "done"


def frame_record(job: Job, index: int) -> dict:
    """What is known of one frame: a line of ``frames.jsonl``."""
    trajectory = job.trajectory
    record = {
        "index": index,
        "pose": int(trajectory.originals[index]),
        "timestamp_s": float(trajectory.timestamps_s[index]),
        "T_world_camera": trajectory.T_world_camera[index].tolist(),
        "checks": {name: round(float(values[index]), 4) for name, values in trajectory.checks.items()},
    }
    if job.gains is not None:
        record["gain"] = float(job.gains[index])
    return {**record, **job.draws[index].to_dict(job.regions)}


def render_shard(job: Job, labeller: Labeller, folder: Path, number: int) -> None:
    """Render shard ``number`` into ``folder`` and mark it as done.

    Args:
        folder: of the unfinished dataset: files go to its ``data``, the mark to its ``done``.
    """
    layout = LAYOUTS[job.layout]
    statistics, clip = Statistics(), Clip()
    tar = None
    if layout.packed:
        tar = _Tar(folder / DATA / f"shard-{number:04d}.tar")
    for index in job.shard(number):
        images = labeller.frame(index, clip)
        statistics.add(images, thumbnail_of=index if index in job.thumbnails else None)
        for name, image in images.items():
            content, place = layout.encoding(name).encode(image), layout.file(job, index, name)
            if tar:
                tar.add(place, content)
            else:
                _write(folder / DATA / place, content)
        if tar:
            key = layout.file(job, index, next(iter(images))).split(".")[0]
            tar.add(f"{key}.json", json.dumps(frame_record(job, index)).encode())
    if tar:
        tar.close()
    mark = folder / DONE / f"{number:06d}.json"
    beside = mark.with_suffix(f".{os.getpid()}.part")
    beside.write_text(json.dumps(statistics.to_dict()), encoding="utf-8")
    beside.replace(mark)


def done_shards(folder: Path) -> dict[int, Statistics]:
    """What is known of the shards that are done, by number."""
    marks = sorted((folder / DONE).glob("*.json")) if (folder / DONE).is_dir() else []
    return {
        int(mark.stem): Statistics.from_dict(json.loads(mark.read_text(encoding="utf-8"))) for mark in marks
    }


def _write(path: Path, content: bytes) -> None:
    try:
        path.write_bytes(content)
    except FileNotFoundError:
        path.parent.mkdir(exist_ok=True)  # but not the dataset's folder, which is gone where the run is
        path.write_bytes(content)


class _Tar:
    """A tar file whose bytes depend on its members alone."""

    def __init__(self, path: Path):
        self._file = tarfile.open(path, "w", format=tarfile.USTAR_FORMAT)  # noqa: SIM115

    def add(self, name: str, content: bytes) -> None:
        member = tarfile.TarInfo(name)
        member.size = len(content)
        self._file.addfile(member, BytesIO(content))

    def close(self) -> None:
        self._file.close()


def total(statistics: list[Statistics]) -> Statistics:
    """The statistics of all shards together."""
    whole = Statistics()
    for each in statistics:
        whole.merge(each)
    return whole

"""Corrected poses as a file that other tools read."""

from __future__ import annotations

from pathlib import Path

from endotwin.run.output import whole_file
from endotwin.sequence import Sequence
from endotwin.sequence.poses import write_c3vd_poses, write_tum_poses
from endotwin.sequence.readers import transforms


def write_poses(path: Path, sequence: Sequence, overwrite: bool = False) -> None:
    """Write the poses of ``sequence`` in its own format: C3VD's rows, a ``transforms.json``, or a TUM
    trajectory, which also stands for SimCol3D's two files.

    Raises:
        OutputError: ``path`` exists or cannot be written.
    """
    with whole_file(Path(path), overwrite) as file:
        if sequence.format == "c3vd":
            write_c3vd_poses(file, sequence.T_world_camera)
        elif sequence.format == "transforms":
            transforms.write_poses(file, sequence)
        else:
            write_tum_poses(file, sequence.T_world_camera, sequence.timestamps_s)

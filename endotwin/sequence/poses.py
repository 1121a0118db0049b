"""Camera poses as files: C3VD's ``pose.txt``, TUM trajectories and ``transforms.json``."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from endotwin.errors import SequenceError, TrajectoryError
from endotwin.run.jsontext import parsed

RIGID_TOLERANCE = 1e-3
LARGEST = 1e12
"""Beyond it no number of a pose or a time makes sense, and float64 is coarser than a micrometre."""
FRAMES_PER_SECOND = 30.0  # assumed where a format has no times
TIME_DIGITS = 6  # of seconds, in names of files
MM_PER_UNIT = {"m": 1000.0, "mm": 1.0}
AXES_OPENGL_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
C3VD_ROW = "16 comma-separated numbers, the camera-to-world matrix column by column"
TUM_ROW = "'timestamp tx ty tz qx qy qz qw'"

logger = logging.getLogger("endotwin")

_AS_WRITTEN = ContextVar("as_written", default=False)


@contextmanager
def poses_as_written() -> Iterator[None]:
    """Within the block, readers return matrices that are not rigid as they are: to tell what is wrong with
    them."""
    token = _AS_WRITTEN.set(True)
    try:
        yield
    finally:
        _AS_WRITTEN.reset(token)


def read_poses(path: Path | str) -> tuple[np.ndarray, np.ndarray]:
    """A trajectory: C3VD's ``pose.txt``, TUM's, or a ``transforms.json``, told apart by content.

    Returns:
        ``T_world_camera`` float64 [N, 4, 4] in mm (TUM's unit is the metre) and timestamps in seconds [N],
        counted at ``FRAMES_PER_SECOND`` where the file has none that rise.

    Raises:
        TrajectoryError: the file is none of these, has no poses, or one that is not rigid.
    """
    path = Path(path)
    try:
        first = next((line.strip() for line in read_text(path).splitlines() if _is_data(line)), "")
        if first.startswith("{"):
            T_world_camera, _ = read_transforms_poses(path)
        elif len(_words(first)) == 8:
            T_world_camera, times_s = read_tum_poses(path)
            if (np.diff(times_s.round(TIME_DIGITS)) > 0).all():
                return T_world_camera, times_s
            logger.warning("the times of %s do not rise: 30 poses a second are assumed", path)
        else:
            T_world_camera = read_c3vd_poses(path)
    except SequenceError as error:
        raise TrajectoryError(str(error)) from error
    if not len(T_world_camera):
        raise TrajectoryError(
            f"{path} has no poses; give a C3VD pose.txt, a TUM trajectory or a transforms.json"
        )
    return T_world_camera, frame_times(len(T_world_camera))


def frame_times(count: int) -> np.ndarray:
    """Timestamps in seconds [N] of frames that come without."""
    return np.arange(count) / FRAMES_PER_SECOND


def rigid(matrices: np.ndarray, where: Callable[[int], str]) -> np.ndarray:
    """Poses [N, 4, 4] with their rotations made exactly orthonormal.

    ``where(i)`` names the place of pose i for the message. Raises SequenceError for numbers that are not
    finite, and where a rotation is off by more than ``RIGID_TOLERANCE``.
    """
    matrices = np.array(matrices, np.float64).reshape(-1, 4, 4)
    _require(
        np.isfinite(matrices).all(axis=(1, 2)), where, "has a NaN or infinity; remove or mend that frame"
    )
    _require(
        (np.abs(matrices) <= LARGEST).all(axis=(1, 2)), where, "is far out of any scene; mend its position"
    )
    if _AS_WRITTEN.get():
        return matrices
    bad = ~is_rigid(matrices)
    if bad.any():
        first = int(bad.argmax())
        remedy = "mend the rotation or remove that frame"
        if is_rigid(matrices[first : first + 1].transpose(0, 2, 1))[0]:
            remedy = "its transpose would be, so write the file's matrices transposed, rows as columns"
        elif np.linalg.det(matrices[first, :3, :3]) < 0:
            remedy = "its axes are left-handed (determinant −1), so mirror one axis of world and camera alike"
        raise SequenceError(f"{where(first)}: the pose is not rigid; {remedy}")
    left, _, right = np.linalg.svd(matrices[:, :3, :3])
    matrices[:, :3, :3] = left @ right
    matrices[:, 3] = (0, 0, 0, 1)
    return matrices


def is_rigid(matrices: np.ndarray) -> np.ndarray:
    """Bool [N]: rotation, no reflection, last row (0, 0, 0, 1), within the tolerance."""
    rotation = matrices[:, :3, :3]
    gram = rotation.transpose(0, 2, 1) @ rotation
    orthonormal = np.abs(gram - np.eye(3)).max(axis=(1, 2)) <= RIGID_TOLERANCE
    last_row = np.abs(matrices[:, 3] - (0, 0, 0, 1)).max(axis=1) <= RIGID_TOLERANCE
    return orthonormal & last_row & (np.linalg.det(rotation) > 0)


def as_poses(given: object) -> np.ndarray:
    """Poses float64 [N, 4, 4] from anything that NumPy reads as matrices [N, 4, 4], or as one [4, 4].

    Raises:
        TrajectoryError: it does not, or they are not rigid.
    """
    try:
        matrices = np.array(given, np.float64)
    except (TypeError, ValueError):
        matrices = np.zeros(0)
    if matrices.ndim not in (2, 3) or matrices.shape[-2:] != (4, 4) or not matrices.size:
        shape = getattr(given, "shape", type(given).__name__)
        raise TrajectoryError(f"poses are matrices [N, 4, 4], camera to world in mm, and not {shape}")
    try:
        return rigid(matrices, lambda i: f"pose {i}")
    except SequenceError as error:
        raise TrajectoryError(str(error)) from error


def as_pose(given: object) -> np.ndarray:
    """One pose float64 [4, 4], as ``as_poses`` reads it; raises TrajectoryError for several, too."""
    poses = as_poses(given)
    if len(poses) > 1:
        raise TrajectoryError(f"one pose [4, 4] is asked for, and not {len(poses)}: give one after the other")
    return poses[0]


def from_quaternions(
    positions_mm: np.ndarray, quaternions: np.ndarray, where: Callable[[int], str]
) -> np.ndarray:
    """Poses float64 [N, 4, 4] from positions [N, 3] and quaternions x y z w [N, 4] of length 1 within 1%."""
    finite = np.isfinite(quaternions).all(axis=1) & np.isfinite(positions_mm).all(axis=1)
    _require(finite, where, "has a NaN or infinity; remove or mend that frame")
    unit = np.abs(np.linalg.norm(quaternions, axis=1) - 1) <= 0.01
    _require(unit, where, "is not rigid: its quaternion is not of length 1; remove or mend that frame")
    matrices = np.tile(np.eye(4), (len(positions_mm), 1, 1))
    if len(matrices):
        matrices[:, :3, :3] = Rotation.from_quat(quaternions).as_matrix()
    matrices[:, :3, 3] = positions_mm
    return matrices


def read_c3vd_poses(path: Path) -> np.ndarray:
    """``T_world_camera`` float64 [N, 4, 4], mm, of a C3VD ``pose.txt``, whose rows are column by column."""
    rows, lines = numeric_rows(path, 16, C3VD_ROW)
    return rigid(rows.reshape(-1, 4, 4).transpose(0, 2, 1), lambda i: f"{path}, line {lines[i]}")


def write_c3vd_poses(path: Path, T_world_camera: np.ndarray) -> None:
    """Write poses [N, 4, 4] as a C3VD ``pose.txt``, in digits that read back to the same float64."""
    rows = np.asarray(T_world_camera, np.float64).transpose(0, 2, 1).reshape(-1, 16).tolist()
    path.write_text("".join(",".join(map(repr, row)) + "\n" for row in rows), encoding="utf-8")


def write_tum_poses(path: Path, T_world_camera: np.ndarray, timestamps_s: np.ndarray) -> None:
    """Write poses [N, 4, 4] in mm with timestamps [N] as a TUM trajectory, in metres."""
    quaternions = Rotation.from_matrix(T_world_camera[:, :3, :3]).as_quat(canonical=True)
    rows = np.c_[timestamps_s, T_world_camera[:, :3, 3] / MM_PER_UNIT["m"], quaternions].tolist()
    lines = ["# timestamp tx ty tz qx qy qz qw", *(" ".join(map(repr, row)) for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_tum_poses(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """``T_world_camera`` float64 [N, 4, 4], mm, and timestamps in seconds [N] of a TUM file, in metres."""
    rows, lines = numeric_rows(path, 8, TUM_ROW)
    where = lambda i: f"{path}, line {lines[i]}"  # noqa: E731
    return from_quaternions(rows[:, 1:4] * MM_PER_UNIT["m"], rows[:, 4:], where), rows[:, 0]


def read_transforms_poses(path: Path) -> tuple[np.ndarray, list[dict]]:
    """``T_world_camera`` float64 [N, 4, 4], mm, and the frames of a ``transforms.json``, in order of names.

    Its cameras look along −z with y up (OpenGL). Its unit is the metre, unless it has ``"unit": "mm"``; where
    it has nerfstudio's ``applied_scale``, positions were multiplied by that, and depth was not.
    """
    content = read_json(path)
    frames = content.get("frames")
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise SequenceError(
            f"{path} has no list 'frames', as a transforms.json has; export it, or name the folder"
        )
    frames = sorted(frames, key=lambda frame: natural_order(str(frame.get("file_path", ""))))
    matrices = np.zeros((len(frames), 4, 4))
    for index, frame in enumerate(frames):
        matrix = frame.get("transform_matrix")
        try:
            matrices[index] = np.array(matrix, np.float64).reshape(4, 4)
        except (TypeError, ValueError) as error:
            name = frame.get("file_path", index)
            raise SequenceError(
                f"{path}, frame {name}: not a pose; a valid transform_matrix is 4 rows of 4 numbers"
            ) from error
    poses = rigid(matrices, lambda i: f"{path}, frame {frames[i].get('file_path', i)}") @ AXES_OPENGL_OPENCV
    poses[:, :3, 3] *= transforms_pose_unit_mm(content, path)
    return poses, frames


def transforms_unit_mm(content: dict, path: Path) -> float:
    """Millimetres in the unit of the ``content`` of the ``transforms.json`` at ``path``."""
    unit = content.get("unit", "m")
    if not isinstance(unit, str) or unit not in MM_PER_UNIT:
        raise SequenceError(f"{path} has the unit {unit!r}; set 'unit' to one of {', '.join(MM_PER_UNIT)}")
    return MM_PER_UNIT[unit]


def transforms_pose_unit_mm(content: dict, path: Path) -> float:
    """Millimetres in the unit of the positions, as ``transforms_unit_mm``."""
    applied = content.get("applied_scale", 1)
    if isinstance(applied, bool) or not isinstance(applied, int | float) or not 0 < applied < np.inf:
        raise SequenceError(f"{path}: 'applied_scale' is {applied!r}; set it to a positive number")
    return transforms_unit_mm(content, path) / applied


def numeric_rows(path: Path, columns: int, valid_row: str) -> tuple[np.ndarray, list[int]]:
    """Rows [N, columns] of a text file, and their line numbers; empty lines and ``#`` comments are skipped.

    Raises SequenceError with the line number and ``valid_row``, what a valid row looks like.
    """
    rows, numbers = [], []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        if not _is_data(line):
            continue
        try:
            row = [float(word) for word in _words(line)]
        except ValueError:
            row = []
        if len(row) != columns or any(LARGEST < abs(value) < np.inf for value in row):
            raise SequenceError(
                f"{path}, line {number}: not a valid row, which is {valid_row}; mend that line"
            )
        rows.append(row)
        numbers.append(number)
    return np.array(rows, np.float64).reshape(-1, columns), numbers


def read_text(path: Path) -> str:
    """The text of a file; raises SequenceError where it cannot be read as text."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise SequenceError(f"There is no file {path}; check the path or add the file") from error
    except (OSError, UnicodeDecodeError) as error:
        raise SequenceError(f"{path} cannot be read as text; give a text file") from error


def read_json(path: Path) -> dict:
    """The object in a JSON file; raises SequenceError where there is none."""
    try:
        content = parsed(read_text(path))
    except ValueError as error:
        raise SequenceError(f"{path} is not JSON ({error}); export the file again") from error
    if not isinstance(content, dict):
        raise SequenceError(f"{path} holds no JSON object; export the file again")
    return content


def natural_order(name: str) -> list[tuple[int, int | str]]:
    """A sorting key under which ``frame_9`` comes before ``frame_10``."""
    return [(0, int(part)) if part.isdecimal() else (1, part) for part in re.split(r"(\d+)", name)]


def _require(good: np.ndarray, where: Callable[[int], str], fault: str) -> None:
    if not good.all():
        raise SequenceError(f"{where(int(good.argmin()))}: the pose {fault}")


def _words(line: str) -> list[str]:
    return [word for word in re.split(r"[,\s]+", line.strip()) if word]


def _is_data(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")

"""Copies of a sequence in C3VD's layout with one mistake planted: what ``endotwin check`` has to name.

Files that a mistake leaves alone are linked, so that a copy costs next to nothing.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import tifffile

LEVELS_PER_MM = 655.35
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


class Copy:
    """A sequence in memory, by names and poses, to be damaged and written."""

    def __init__(self, source: Path) -> None:
        self.colors = sorted(source.glob("*_color.png"))
        self.depths = sorted(source.glob("*_depth.tiff"))
        rows = np.loadtxt(source / "pose.txt", delimiter=",")
        self.T = rows.reshape(-1, 4, 4).transpose(0, 2, 1)
        self.camera = json.loads((source / "camera.json").read_text())
        self.photo: dict[int, Callable[[np.ndarray], np.ndarray]] = {}
        self.depth: dict[int, Callable[[np.ndarray], np.ndarray]] = {}

    def __len__(self) -> int:
        return len(self.colors)

    def keep(self, frames: list[int]) -> None:
        """Only these frames, in this order."""
        self.colors, self.depths = ([files[k] for k in frames] for files in (self.colors, self.depths))
        self.T = self.T[frames]

    def every_photo(self, change: Callable[[np.ndarray], np.ndarray]) -> None:
        self.photo = dict.fromkeys(range(len(self)), change)

    def every_depth(self, change: Callable[[np.ndarray], np.ndarray]) -> None:
        """Change depth maps, float64 in mm, NaN where there is none."""
        self.depth = dict.fromkeys(range(len(self)), change)

    def write(self, folder: Path, noise: float = 0.0) -> Path:
        """Write the copy, its depth with relative white ``noise``."""
        folder.mkdir(parents=True)
        for index, (color, depth) in enumerate(zip(self.colors, self.depths, strict=True)):
            stem = folder / f"{index:04d}_"
            if index in self.photo:
                cv2.imwrite(f"{stem}color.png", self.photo[index](cv2.imread(str(color))))
            else:
                Path(f"{stem}color.png").symlink_to(color.resolve())
            if index in self.depth or noise:
                change = self.depth.get(index, lambda depth_mm: depth_mm)
                raw = _noisy(tifffile.imread(depth), noise, index)
                tifffile.imwrite(f"{stem}depth.tiff", _encoded(change(_decoded(raw))), compression="zlib")
            else:
                Path(f"{stem}depth.tiff").symlink_to(depth.resolve())
        np.savetxt(folder / "pose.txt", self.T.transpose(0, 2, 1).reshape(-1, 16), "%.12g", delimiter=",")
        (folder / "camera.json").write_text(json.dumps(self.camera))
        return folder


@dataclass(frozen=True)
class Damage:
    """A planted mistake.

    Attributes:
        do: damages a copy.
        named: kinds of findings that name it.
    """

    do: Callable[[Copy], None]
    named: tuple[str, ...]


def _decoded(raw: np.ndarray) -> np.ndarray:
    return np.where((raw == 0) | (raw == 65535), np.nan, raw / LEVELS_PER_MM)


def _encoded(depth_mm: np.ndarray) -> np.ndarray:
    raw = np.rint(depth_mm * LEVELS_PER_MM)
    return np.where(np.isfinite(raw), np.clip(raw, 0, 65535), 0).astype(np.uint16)


def _noisy(raw: np.ndarray, noise: float, seed: int) -> np.ndarray:
    if not noise:
        return raw
    white = np.random.default_rng(seed).standard_normal(raw.shape)
    return np.where((raw == 0) | (raw == 65535), raw, np.clip(raw * (1 + noise * white), 1, 65534))


def _transposed(copy: Copy) -> None:
    copy.T = copy.T.transpose(0, 2, 1)


def _inverted(copy: Copy) -> None:
    copy.T = np.linalg.inv(copy.T)


def _opengl(copy: Copy) -> None:
    copy.T = copy.T @ OPENGL


def _inverted_opengl(copy: Copy) -> None:
    copy.T = np.linalg.inv(copy.T @ OPENGL)


def _rotation_transposed(copy: Copy) -> None:
    copy.T[:, :3, :3] = copy.T[:, :3, :3].transpose(0, 2, 1)


def _translation_inverted(copy: Copy) -> None:
    copy.T[:, :3, 3] = np.linalg.inv(copy.T)[:, :3, 3]


def _left_handed(copy: Copy) -> None:
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    copy.T = mirror @ copy.T @ mirror


def _reflected(copy: Copy) -> None:
    copy.T = copy.T @ np.diag([1.0, -1.0, 1.0, 1.0])


def _axes_turned(copy: Copy) -> None:
    turn = np.eye(4)
    turn[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    copy.T = copy.T @ turn


def translations(factor: float) -> Callable[[Copy], None]:
    """Translations of the poses times ``factor``."""

    def do(copy: Copy) -> None:
        copy.T[:, :3, 3] *= factor

    return do


def depths(factor: float) -> Callable[[Copy], None]:
    """Depth times ``factor``."""
    return lambda copy: copy.every_depth(lambda depth_mm: depth_mm * factor)


def _along_ray(copy: Copy) -> None:
    from endotwin.cameras import camera_from_dict

    z = camera_from_dict(copy.camera, Path()).pixel_directions[..., 2]
    copy.every_depth(lambda depth_mm: np.where(z > 0.05, depth_mm / np.maximum(z, 0.05), np.nan))


def resolution(ratio_u: float, ratio_v: float) -> Callable[[Copy], None]:
    """The numbers of a calibration at another size, under this size."""

    def do(copy: Copy) -> None:
        c = copy.camera
        c["cx"], c["cy"] = (c["cx"] + 0.5) * ratio_u - 0.5, (c["cy"] + 0.5) * ratio_v - 0.5
        if "fx" in c:
            c["fx"], c["fy"] = c["fx"] * ratio_u, c["fy"] * ratio_v
        else:
            c["a0"], c["c"], c["d"] = (
                c["a0"] * ratio_v,
                c["c"] * ratio_u / ratio_v,
                c["d"] * ratio_u / ratio_v,
            )
            c["a2"], c["a3"], c["a4"] = c["a2"] / ratio_v, c["a3"] / ratio_v**2, c["a4"] / ratio_v**3

    return do


def _other_size(copy: Copy) -> None:
    ratio = 1.5
    resolution(ratio, ratio)(copy)
    copy.camera["width"], copy.camera["height"] = (round(copy.camera[k] * ratio) for k in ("width", "height"))


def _focal(copy: Copy) -> None:
    for key in {"fx", "fy"} & set(copy.camera) or {"a0"}:
        copy.camera[key] *= 1.03


def centre(shift_u: float, shift_v: float) -> Callable[[Copy], None]:
    """The principal point moved, in pixels."""

    def do(copy: Copy) -> None:
        copy.camera["cx"] += shift_u
        copy.camera["cy"] += shift_v

    return do


def _photos_shifted(copy: Copy) -> None:
    copy.colors, copy.depths, copy.T = copy.colors[1:], copy.depths[:-1], copy.T[:-1]


def _depth_shifted(copy: Copy) -> None:
    copy.colors, copy.depths, copy.T = copy.colors[:-1], copy.depths[1:], copy.T[:-1]


def poses_shifted(frames: int) -> Callable[[Copy], None]:
    """Each frame gets the pose of a later one."""

    def do(copy: Copy) -> None:
        copy.colors, copy.depths, copy.T = copy.colors[:-frames], copy.depths[:-frames], copy.T[frames:]

    return do


def _reversed(copy: Copy) -> None:
    copy.T = copy.T[::-1]


def _alphabetic(copy: Copy) -> None:
    copy.T = copy.T[sorted(range(len(copy)), key=str)]


def _photos_mirrored(copy: Copy) -> None:
    copy.every_photo(lambda photo: photo[:, ::-1])


def _depth_mirrored(copy: Copy) -> None:
    copy.every_depth(lambda depth_mm: depth_mm[:, ::-1])


def _images_mirrored(copy: Copy) -> None:
    _photos_mirrored(copy)
    _depth_mirrored(copy)


def photos_moved(shift_u: float, shift_v: float) -> Callable[[Copy], None]:
    """Photos moved against their depth maps, in pixels."""
    matrix = np.float32([[1, 0, shift_u], [0, 1, shift_v]])
    border = {"flags": cv2.INTER_CUBIC, "borderMode": cv2.BORDER_REPLICATE}
    return lambda copy: copy.every_photo(
        lambda photo: cv2.warpAffine(photo, matrix, photo.shape[1::-1], **border)
    )


def _photo_repeated(copy: Copy) -> None:
    copy.colors[len(copy) // 2] = copy.colors[len(copy) // 2 - 1]


def _frame_repeated(copy: Copy) -> None:
    k = len(copy) // 2
    copy.keep([*range(k), k - 1, *range(k, len(copy))])


def _blurred(copy: Copy) -> None:
    for k in (len(copy) // 3, len(copy) // 2):
        copy.photo[k] = lambda photo: cv2.GaussianBlur(photo, (0, 0), photo.shape[1] / 250)


def _one_pose_off(copy: Copy) -> None:
    turn = np.eye(4)
    turn[:3, :3] = cv2.Rodrigues(np.radians([1.0, -0.5, 0.5]))[0]
    turn[:3, 3] = 0.3, 0.2, -0.3
    copy.T[len(copy) // 2] = copy.T[len(copy) // 2] @ turn


def _one_pose_for_all(copy: Copy) -> None:
    copy.T[:] = copy.T[0]


def _poses_swapped(copy: Copy) -> None:
    k = len(copy) // 2
    copy.T[[k, k + 1]] = copy.T[[k + 1, k]]


def _photos_swapped(copy: Copy) -> None:
    k = len(copy) // 2
    copy.colors[k], copy.colors[k + 1] = copy.colors[k + 1], copy.colors[k]


DAMAGES: dict[str, Damage] = {
    "poses transposed": Damage(_transposed, ("poses_transposed",)),
    "poses inverted": Damage(_inverted, ("poses_inverted",)),
    "poses OpenGL": Damage(_opengl, ("poses_opengl",)),
    "poses OpenGL, inverted": Damage(_inverted_opengl, ("poses_inverted", "poses_opengl")),
    "rotations transposed": Damage(_rotation_transposed, ("poses_rotation_transposed",)),
    "translations inverted": Damage(_translation_inverted, ("poses_translation_inverted",)),
    "poses left-handed": Damage(_left_handed, ("poses_left_handed", "images_mirrored")),
    "poses reflected": Damage(_reflected, ("poses_left_handed", "images_mirrored")),
    "camera axes turned": Damage(_axes_turned, ("poses_axes",)),
    "poses in m": Damage(translations(0.001), ("pose_unit",)),
    "poses in µm": Damage(translations(1000.0), ("pose_unit",)),
    "poses in cm": Damage(translations(0.1), ("pose_unit",)),
    "depth in 0.01 mm": Damage(depths(100 / LEVELS_PER_MM), ("depth_unit",)),
    "depth in mm": Damage(depths(1 / LEVELS_PER_MM), ("depth_unit",)),
    "depth × 1000": Damage(depths(1000.0), ("depth_clipped",)),
    "depth along rays": Damage(_along_ray, ("depth_along_ray",)),
    "intrinsics of 1350×1080": Damage(resolution(1350 / 640, 1080 / 480), ("intrinsics_scale",)),
    "intrinsics of half size": Damage(resolution(0.5, 0.5), ("intrinsics_scale",)),
    "intrinsics of twice the size": Damage(resolution(2, 2), ("intrinsics_scale",)),
    "camera.json of another size": Damage(_other_size, ("intrinsics_size",)),
    "focal length + 3 %": Damage(_focal, ("focal_length",)),
    "principal point + 0.5 px": Damage(centre(0.5, 0.5), ("principal_point",)),
    "principal point − 4, + 3 px": Damage(centre(-4, 3), ("principal_point",)),
    "photos one frame late": Damage(_photos_shifted, ("photos_shifted",)),
    "depth one frame late": Damage(_depth_shifted, ("depth_shifted",)),
    "poses one frame late": Damage(poses_shifted(1), ("poses_shifted",)),
    "poses three frames late": Damage(poses_shifted(3), ("poses_shifted",)),
    "poses in reverse": Damage(_reversed, ("poses_order",)),
    "poses in alphabetic order": Damage(_alphabetic, ("poses_order",)),
    "photos mirrored": Damage(_photos_mirrored, ("photos_mirrored",)),
    "depth mirrored": Damage(_depth_mirrored, ("depth_mirrored",)),
    "photos and depth mirrored": Damage(_images_mirrored, ("images_mirrored", "poses_left_handed")),
    "photos + 0.7 px": Damage(photos_moved(0.7, 0.7), ("photos_offset",)),
    "photos + 6, − 4 px": Damage(photos_moved(6, -4), ("photos_offset",)),
    "one photo repeated": Damage(_photo_repeated, ("duplicate",)),
    "one frame repeated": Damage(_frame_repeated, ("duplicate",)),
    "two photos blurred": Damage(_blurred, ("blurred",)),
    "one pose for all": Damage(_one_pose_for_all, ("poses_still",)),
    "one pose off": Damage(_one_pose_off, ("misregistered",)),
    "two poses swapped": Damage(_poses_swapped, ("mistimed",)),
    "two photos swapped": Damage(_photos_swapped, ("mistimed",)),
}

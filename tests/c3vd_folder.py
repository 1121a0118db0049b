"""A small sequence in C3VD's layout, written by Pillow and tifffile alone."""

import json
from pathlib import Path

import numpy as np
import tifffile
from PIL import Image
from scipy.spatial.transform import Rotation

H, W = 48, 64
CAMERA = {"model": "pinhole", "width": W, "height": H, "fx": 40, "fy": 41, "cx": 31.5, "cy": 23.5}


def photo(index: int, size: tuple[int, int] = (H, W)) -> np.ndarray:
    """A picture of noise, uint8 [H, W, 3], other for each index."""
    return np.random.default_rng(index).integers(0, 256, (*size, 3), np.uint8)


def truth_poses(count: int) -> np.ndarray:
    """Random rigid poses, float64 [N, 4, 4]."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, np.random.default_rng(5)).as_matrix()
    poses[:, :3, 3] = np.random.default_rng(6).uniform(-50, 50, (count, 3))
    return poses


def write_c3vd(folder: Path, color=None, depth=None, count: int = 3, camera: dict = CAMERA) -> Path:
    """Photos and 16-bit depth (noise unless given), ``pose.txt`` and ``camera.json``; returns the folder."""
    folder.mkdir(exist_ok=True)
    color = color or [photo(index) for index in range(count)]
    noise = np.random.default_rng(0).integers(30000, 31000, (H, W)).astype(np.uint16)
    depth = depth or [noise] * len(color)
    for index, (picture, raw) in enumerate(zip(color, depth, strict=True)):
        Image.fromarray(picture).save(folder / f"{index:04d}_color.png")
        tifffile.imwrite(folder / f"{index:04d}_depth.tiff", raw, compression="zlib", predictor=True)
    rows = [",".join(f"{value:.12g}" for value in pose.T.ravel()) for pose in truth_poses(len(color))]
    (folder / "pose.txt").write_text("\n".join(rows) + "\n")
    (folder / "camera.json").write_text(json.dumps(camera))
    return folder

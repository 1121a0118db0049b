"""Your own photos, depth maps and poses, from arrays to a twin.

    python examples/custom_sequence.py custom

Writes a sequence folder in C3VD's layout, ``custom/sequence``, from numpy arrays; then fuses, fits,
evaluates and renders it. The arrays here come from a formula (a painted tube, lit from the lens). To use your
own, replace ``recording()`` and keep its conventions: depth along the optical axis in mm, poses
camera-to-world in mm, camera axes x right, y down, z forward.
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import tifffile

import endotwin

WIDTH, HEIGHT, FOCAL_PX = 160, 120, 96.0
CAMERA = {
    "model": "pinhole",
    "width": WIDTH,
    "height": HEIGHT,
    "fx": FOCAL_PX,
    "fy": FOCAL_PX,
    "cx": (WIDTH - 1) / 2,
    "cy": (HEIGHT - 1) / 2,
}
C3VD_DEPTH_RANGE_MM = 100.0


def recording(frames: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Photos uint8 [H, W, 3] RGB, z-depth [H, W] in mm (NaN: none) and camera-to-world poses [4, 4]."""
    u, v = np.meshgrid(np.arange(WIDTH) - CAMERA["cx"], np.arange(HEIGHT) - CAMERA["cy"])
    rays = np.stack([u, v, np.full(u.shape, FOCAL_PX)], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    for k in range(frames):
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues(np.array([0.1 * np.cos(k), 0.1 * np.sin(k), 0.0]))[0]
        pose[:3, 3] = np.sin(0.7 * k), np.cos(0.5 * k), 0.8 * k
        photo, depth_mm = photograph(rays, pose)
        yield photo, depth_mm, pose


def photograph(rays: np.ndarray, pose: np.ndarray, radius_mm: float = 12.0, end_mm: float = 50.0):
    """Photo and depth of a tube about the z axis, closed at ``end_mm``."""
    world, origin = rays @ pose[:3, :3].T, pose[:3, 3]
    a, b = (world[..., :2] ** 2).sum(-1), (world[..., :2] * origin[:2]).sum(-1)
    to_wall = (-b + np.sqrt(b * b + a * (radius_mm**2 - (origin[:2] ** 2).sum()))) / a
    to_end = (end_mm - origin[2]) / world[..., 2]
    distance = np.minimum(to_wall, to_end)
    point = origin + distance[..., None] * world
    normal = np.where((to_end < to_wall)[..., None], [0, 0, -1], -point * [1, 1, 0] / radius_mm)
    paint = 0.55 + 0.2 * np.sin(3 * np.arctan2(point[..., 1], point[..., 0]) + 0.5 * point[..., 2])
    cosine = -(normal * world).sum(-1)
    radiance = paint * 2 * cosine * 60 * rays[..., 2] ** 2 / distance**2
    color = (radiance[..., None] * [0.8, 0.45, 0.35]).clip(0, 1) ** (1 / 2.2)
    return np.uint8(color * 255 + 0.5), distance * rays[..., 2]


def write_sequence(folder: Path, frames: int) -> None:
    """Write a recording as endotwin reads it: photos, 16-bit depth, one pose a line, the camera."""
    folder.mkdir(parents=True)
    poses = []
    for index, (photo, depth_mm, pose) in enumerate(recording(frames)):
        raw = np.uint16(np.nan_to_num(depth_mm / C3VD_DEPTH_RANGE_MM * 65535).clip(0, 65535).round())
        cv2.imwrite(str(folder / f"{index:04d}_color.png"), photo[..., ::-1])
        tifffile.imwrite(folder / f"{index:04d}_depth.tiff", raw)
        poses.append(",".join(f"{value:.9f}" for value in pose.T.ravel()))
    (folder / "pose.txt").write_text("\n".join(poses) + "\n")
    (folder / "camera.json").write_text(json.dumps(CAMERA, indent=1) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("output", type=Path, help="folder to make")
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--budget", type=float, default=20, help="seconds for the fit")
    options = parser.parse_args()

    write_sequence(options.output / "sequence", options.frames)
    twin = endotwin.fuse_twin(options.output / "sequence")
    twin = endotwin.fit_twin(twin, budget_s=options.budget)
    evaluation = endotwin.evaluate(twin, sheet=options.output / "sheet.png")
    print(evaluation)
    twin = twin.with_record(eval=evaluation.to_dict())
    twin.save(options.output / "twin")
    print(endotwin.synthesize(twin, "jitter:frames=8", options.output / "dataset"))
    print(twin)


if __name__ == "__main__":
    main()

"""A small C3VD sequence written without endotwin: a camera flies along a closed, painted cylinder.

Lambertian wall, light at the lens with L = L0·cos²θ/d², response x^(1/2.2). Everything is analytic.
"""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import tifffile

RADIUS_MM, CAP_MM = 10.0, 45.0
GAMMA, CONE, FALLOFF = 1 / 2.2, 2.0, 2.0
DEPTH_RANGE_MM = 100.0


def poses(count: int) -> np.ndarray:
    """Camera-to-world matrices [count, 4, 4] of a wavy flight along the cylinder's axis, z."""
    T = np.tile(np.eye(4), (count, 1, 1))
    for k in range(count):
        yaw, pitch = 0.12 * np.sin(1.3 * k), 0.1 * np.cos(0.9 * k)
        R = cv2.Rodrigues(np.array([pitch, yaw, 0.05 * k]))[0]
        T[k, :3, :3] = R
        T[k, :3, 3] = 1.5 * np.sin(0.7 * k), 1.2 * np.cos(0.5 * k), 1.0 * k
    return T


def camera_json(width: int, height: int) -> dict:
    """A pinhole camera with a horizontal field of view of 80°."""
    focal = 0.6 * width
    return {
        "model": "pinhole",
        "width": width,
        "height": height,
        "fx": focal,
        "fy": focal,
        "cx": (width - 1) / 2,
        "cy": (height - 1) / 2,
    }


def photograph(camera: dict, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Photo uint8 [H, W, 3] and z-depth float64 [H, W] in mm."""
    u, v = np.meshgrid(np.arange(camera["width"]), np.arange(camera["height"]))
    rays = np.stack(
        [(u - camera["cx"]) / camera["fx"], (v - camera["cy"]) / camera["fy"], np.ones(u.shape)], -1
    )
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    world, origin = rays @ T_world_camera[:3, :3].T, T_world_camera[:3, 3]
    a = (world[..., :2] ** 2).sum(-1)
    b = (world[..., :2] * origin[:2]).sum(-1)
    wall = (-b + np.sqrt(b * b + a * (RADIUS_MM**2 - (origin[:2] ** 2).sum()))) / a
    with np.errstate(divide="ignore"):
        cap = np.where(world[..., 2] > 0, (CAP_MM - origin[2]) / world[..., 2], np.inf)
    distance = np.minimum(wall, cap)
    point = origin + distance[..., None] * world
    inward = np.where((cap < wall)[..., None], [0, 0, -1.0], -point * [1, 1, 0] / RADIUS_MM)
    angle = np.arctan2(point[..., 1], point[..., 0])
    wave = 0.5 + 0.25 * np.sin(3 * angle + 0.4 * point[..., 2]) + 0.2 * np.cos(0.9 * point[..., 2])
    albedo = wave[..., None] * [0.8, 0.45, 0.35]
    light = 40.0 * rays[..., 2] ** CONE / distance**FALLOFF
    radiance = albedo / np.pi * (light * -(inward * world).sum(-1) * 2 * np.pi)[..., None]
    return np.uint8(np.clip(radiance**GAMMA, 0, 1) * 255 + 0.5), distance * rays[..., 2]


def write(folder: Path, frames: int = 10, width: int = 96, height: int = 72) -> Path:
    """Write the sequence in C3VD v1's layout and return ``folder``."""
    folder.mkdir(parents=True)
    camera = camera_json(width, height)
    T_world_camera = poses(frames)
    for index, T in enumerate(T_world_camera):
        photo, depth_mm = photograph(camera, T)
        cv2.imwrite(str(folder / f"{index:04d}_color.png"), photo[..., ::-1])
        tifffile.imwrite(
            folder / f"{index:04d}_depth.tiff", np.uint16(depth_mm / DEPTH_RANGE_MM * 65535 + 0.5)
        )
    (folder / "camera.json").write_text(json.dumps(camera))
    write_poses(folder / "pose.txt", T_world_camera)
    return folder


def write_poses(path: Path, T_world_camera: np.ndarray) -> None:
    """C3VD's pose.txt: each line a camera-to-world matrix, column by column."""
    lines = [",".join(f"{value:.9f}" for value in T.T.ravel()) for T in T_world_camera]
    path.write_text("\n".join(lines) + "\n")

"""The bundled example agrees with itself and with the physics it was rendered by, judged without endotwin."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates, maximum_filter, minimum_filter

SCRIPT = Path(__file__).parents[1] / "examples" / "make_colon_small.py"
FRAMES = 24


@pytest.fixture(scope="module")
def poses(example: Path) -> np.ndarray:
    return np.loadtxt(example / "pose.txt", delimiter=",").reshape(-1, 4, 4).transpose(0, 2, 1)


def depth_mm(example: Path, index: int) -> np.ndarray:
    raw = cv2.imread(str(example / f"{index:04d}_depth.tiff"), cv2.IMREAD_UNCHANGED)
    return np.where((raw > 0) & (raw < 65535), raw / 65535 * 100, np.nan)


def rgb(path: Path) -> np.ndarray:
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1].astype(np.float64)


def rays(example: Path) -> np.ndarray:
    """Viewing directions of the pixel centres, with z = 1: [H, W, 3]."""
    camera = json.loads((example / "camera.json").read_text())
    u, v = np.meshgrid(np.arange(camera["width"]), np.arange(camera["height"]))
    return np.stack(
        [(u - camera["cx"]) / camera["fx"], (v - camera["cy"]) / camera["fy"], np.ones(u.shape)], axis=-1
    )


def without_jumps(depth: np.ndarray) -> np.ndarray:
    """Pixels whose 5×5 neighbourhood has depth everywhere and no fold's rim in it."""
    filled = np.nan_to_num(depth)
    nearest, farthest = minimum_filter(filled, 5), maximum_filter(filled, 5)
    return (nearest > 0) & (farthest - nearest < 0.1 * nearest)


def principled_colocated(albedo: np.ndarray, roughness: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """Disney's BRDF [N, 3] (Burley 2012 and 2015; metallic 0, specular 0.5) with the light at the lens.

    The half vector is the viewing direction, where Fresnel's reflectance is ((1.5 - 1)/(1.5 + 1))² = 0.04.
    """
    weight, retro = (1 - cosine) ** 5, 2 * roughness
    diffuse = (1 - 0.5 * weight) ** 2 + retro * (2 * weight + weight**2 * (retro - 1))
    alpha2 = roughness**4
    D = alpha2 / (np.pi * (cosine**2 * (alpha2 - 1) + 1) ** 2)
    G1 = 2 / (1 + np.sqrt(1 + alpha2 * (1 / cosine**2 - 1)))
    return albedo / np.pi * diffuse[:, None] + (0.04 * D * G1**2 / (4 * cosine**2))[:, None]


def test_example_is_complete_and_small(example, poses):
    for name in ("color.png", "depth.tiff"):
        assert sorted(p.name for p in example.glob(f"*_{name}")) == [f"{i:04d}_{name}" for i in range(FRAMES)]
    assert len(poses) == FRAMES
    assert sum(p.stat().st_size for p in example.rglob("*")) < 6e6
    for index in range(FRAMES):
        assert rgb(example / f"{index:04d}_color.png").shape == (240, 320, 3)
        assert np.isfinite(depth_mm(example, index)).mean() > 0.95


def test_poses_are_rigid_and_close_together(poses):
    R = poses[:, :3, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-7)
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-7)
    np.testing.assert_array_equal(poses[:, 3], np.tile([0, 0, 0, 1], (FRAMES, 1)))
    step_mm = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert step_mm.min() > 0.3 and step_mm.max() < 1.2


def test_depth_maps_of_neighbouring_frames_show_one_surface(example, poses):
    directions = rays(example)
    fx, (cx, cy) = 0.6 * 320, (159.5, 119.5)
    for i in range(FRAMES - 1):
        here, there = depth_mm(example, i), depth_mm(example, i + 1)
        points = (directions * here[..., None])[without_jumps(here)]
        T = np.linalg.inv(poses[i + 1]) @ poses[i]
        x, y, z = (points @ T[:3, :3].T + T[:3, 3]).T
        u, v = fx * x / z + cx, fx * y / z + cy
        inside = (u > 2) & (u < 317) & (v > 2) & (v < 237)
        flat = map_coordinates(without_jumps(there).astype(float), [v[inside], u[inside]], order=0) > 0
        seen = map_coordinates(np.nan_to_num(there), [v[inside], u[inside]], order=1)
        error_mm = np.abs(seen - z[inside])[flat]
        assert error_mm.size > 40_000
        assert np.median(error_mm) < 0.002
        assert np.quantile(error_mm, 0.95) < 0.02


def test_normals_are_those_of_the_depth_map(example):
    raw = rgb(example / "0000_normals.tiff")
    normals = raw / 65535 * 2 - 1
    points = rays(example) * depth_mm(example, 0)[..., None]
    across, down = np.gradient(points, axis=1), np.gradient(points, axis=0)
    measured = -np.cross(across, down)
    measured /= np.linalg.norm(measured, axis=-1, keepdims=True)
    keep = without_jumps(depth_mm(example, 0))
    np.testing.assert_allclose(np.linalg.norm(normals[keep], axis=-1), 1, atol=1e-4)
    angle_deg = np.degrees(np.arccos(np.clip((normals * measured).sum(-1)[keep], -1, 1)))
    assert np.median(angle_deg) < 1.5


def test_photo_is_the_principled_brdf_under_cos2_light_with_inverse_square_to_within_noise(example):
    made = json.loads((example / "truth" / "made.json").read_text())
    directions, depth = rays(example), depth_mm(example, 0)
    normals = rgb(example / "0000_normals.tiff") / 65535 * 2 - 1
    length = np.linalg.norm(directions, axis=-1)
    cosine = -(normals * directions).sum(-1) / length
    photo = rgb(example / "0000_color.png")
    keep = without_jumps(depth) & (cosine > 0.2) & (photo.max(-1) < 250)
    albedo = rgb(example / "truth" / "0000_albedo.png")[keep] / 255
    roughness = cv2.imread(str(example / "truth" / "0000_roughness.png"), cv2.IMREAD_UNCHANGED)[keep] / 255
    light = made["light"]["intensity"] * length[keep] ** -2 / (depth * length)[keep] ** 2
    radiance = principled_colocated(albedo, roughness, cosine[keep]) * (light * cosine[keep])[:, None]
    residual = photo[keep] - 255 * radiance ** made["gamma"]
    assert len(residual) > 40_000
    assert abs(np.median(residual)) < 0.1
    spread = 1.4826 * np.median(np.abs(residual))
    noise = np.sqrt(made["noise_levels"] ** 2 + 1 / 12)
    assert 0.95 * noise < spread < 1.15 * noise


@pytest.mark.skipif(importlib.util.find_spec("mitsuba") is None, reason="mitsuba is not installed")
def test_script_writes_the_same_bytes_for_the_same_seed(tmp_path):
    size = ["--frames", "2", "--width", "64", "--height", "48", "--edge-mm", "0.6"]
    for name, seed in (("first", "3"), ("second", "3"), ("other", "4")):
        command = [sys.executable, str(SCRIPT), "-o", str(tmp_path / name), "--seed", seed, *size]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    files = sorted(p.relative_to(tmp_path / "first") for p in (tmp_path / "first").rglob("*.*"))
    assert len(files) == 2 * 2 + 1 + 2 + 2 + 2
    for file in files:
        assert (tmp_path / "first" / file).read_bytes() == (tmp_path / "second" / file).read_bytes()
    photo = "0000_color.png"
    assert (tmp_path / "first" / photo).read_bytes() != (tmp_path / "other" / photo).read_bytes()

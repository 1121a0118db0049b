"""A scene as a folder in C3VD's layout, with its truth."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np

from independent.picture import Studio
from independent.scene import Scene
from independent.shown import shown_levels, wrong_levels

DEPTH_RANGE_MM = 100.0
MADE = Path("truth") / "made.json"


def make(scene: Scene, folder: Path) -> dict:
    """Render the scene into ``folder``, unless it is there already, and return the content of its
    ``truth/made.json``."""
    if (folder / MADE).exists() and _is_of(scene, made := json.loads((folder / MADE).read_text())):
        return made
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "truth").mkdir(parents=True)
    studio = Studio(scene)
    rng = np.random.default_rng([scene.seed, 9])
    for frame in range(scene.frames):
        photo, depth_mm = studio.photo(frame, rng)
        raw = np.rint(np.clip(depth_mm / DEPTH_RANGE_MM, 0, 1) * 65535).astype(np.uint16)
        cv2.imwrite(str(folder / f"{frame:04d}_color.png"), photo[..., ::-1])
        cv2.imwrite(str(folder / f"{frame:04d}_depth.tiff"), raw)
    rows = studio.poses.transpose(0, 2, 1).reshape(-1, 16)
    (folder / "pose.txt").write_text("".join(",".join(f"{x:.9g}" for x in row) + "\n" for row in rows))
    (folder / "camera.json").write_text(json.dumps(scene.lens.to_dict(), indent=1) + "\n")
    made = studio.scene.to_dict() | {"shown": shown_levels(studio), "wrong_levels": wrong_levels(studio)}
    (folder / MADE).write_text(json.dumps(made, indent=1) + "\n")
    return made


def _is_of(scene: Scene, made: dict) -> bool:
    """Whether ``made.json`` tells of this scene: all that is drawn is the same."""
    drawn = json.loads(json.dumps(scene.to_dict()))
    return all(made.get(name) == value for name, value in drawn.items() if name != "L0")

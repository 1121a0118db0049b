"""What errors of poses, depth and intrinsics cost: a sequence is spoilt by known amounts and scored as ever.

    python benchmarks/perturbed.py examples/colon_small --scale 0.5

Photos and protocol stay as they are. The held-out frames are spoilt like the others, since a user has no
better; what a twin is worth under exact poses is therefore higher than these scores, but for those "by
halves": of each half of a photo at the pose that was fitted to its other half. Noise of depth is
independent from pixel to pixel, noise of poses from frame to frame, and both are Gaussian.
"""

import argparse
import json
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path

import cv2
import numpy as np
import tifffile
from scipy.spatial.transform import Rotation

import endotwin
from endotwin.sequence import Sequence
from endotwin.sequence.poses import write_c3vd_poses
from endotwin.sequence.readers.c3vd import DEPTH_RANGE_MM

FOCAL = {"fx", "fy", "a0"}


@dataclass(frozen=True)
class Error:
    """What is wrong: standard deviations of poses (mm, degrees) and depth (of itself); by what share a focal
    length is too long, and the principal point off by a share of the image's width.
    """

    move_mm: float = 0.0
    turn_deg: float = 0.0
    depth: float = 0.0
    focal: float = 0.0
    centre: float = 0.0


ERRORS = {
    "none": Error(),
    **{f"position, σ {mm:g} mm": Error(move_mm=mm) for mm in (0.05, 0.1, 0.2, 0.5, 1.0)},
    **{f"rotation, σ {deg:g}°": Error(turn_deg=deg) for deg in (0.05, 0.1, 0.2, 0.5, 1.0)},
    **{f"depth, σ {100 * share:g} %": Error(depth=share) for share in (0.002, 0.005, 0.01, 0.02)},
    "focal length, 1 % too long": Error(focal=0.01),
    "principal point, 1 % of the width aside": Error(centre=0.01),
}


def spoilt(sequence: Sequence, error: Error, folder: Path, seed: int) -> Path:
    """``sequence`` with ``error``, written as C3VD v1 to ``folder``, which is returned."""
    generator = np.random.default_rng(seed)
    folder.mkdir()
    poses = sequence.T_world_camera.copy()
    for T in poses:
        T[:3, 3] += generator.normal(0, error.move_mm, 3)
        T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(generator.normal(0, error.turn_deg, 3), True).as_matrix()
    for index in range(len(sequence)):
        depth_mm = sequence.depth_mm(index)
        depth_mm = depth_mm * (1 + error.depth * generator.standard_normal(depth_mm.shape))
        raw = np.nan_to_num(np.clip(depth_mm / DEPTH_RANGE_MM * 65535, 0, 65535) + 0.5)
        tifffile.imwrite(folder / f"{index:04d}_depth.tiff", raw.astype(np.uint16))
        cv2.imwrite(str(folder / f"{index:04d}_color.png"), sequence.color(index)[..., ::-1])
    camera = sequence.camera
    longer = {name: getattr(camera, name) * (1 + error.focal) for name in _names(camera) & FOCAL}
    camera = replace(camera, **longer, cx=camera.cx + error.centre * camera.width)
    (folder / "camera.json").write_text(json.dumps(camera.to_dict()))
    write_c3vd_poses(folder / "pose.txt", poses)
    return folder


def _names(camera: object) -> set[str]:
    return {field.name for field in fields(camera)}


def rows(options: argparse.Namespace) -> Iterator[list[str]]:
    """The table, a row an error."""
    sequence, clean_db = endotwin.open_sequence(options.sequence, scale=options.scale), 0.0
    chosen = {name: error for name, error in ERRORS.items() if name == "none" or options.only in name}
    for number, (name, error) in enumerate(chosen.items()):
        with tempfile.TemporaryDirectory() as work:
            fused = endotwin.fuse_twin(spoilt(sequence, error, Path(work) / "spoilt", options.seed))
            twin = endotwin.fit_twin(fused, align="off")
            scores = endotwin.evaluate(twin)
            aligned = endotwin.evaluate(endotwin.fit_twin(fused, align="auto"), halves=True)
        clean_db = scores.psnr_covered if number == 0 else clean_db
        yield [
            name,
            f"{scores.psnr:.2f} dB",
            f"{scores.psnr_covered:.2f} dB",
            f"{clean_db - scores.psnr_covered:+.2f} dB",
            f"{twin.response.gamma:.4f}",
            f"{twin.light.n:.3f}",
            f"{twin.light.q:.3f}",
            f"{aligned.psnr_covered:.2f} dB",
            f"{clean_db - aligned.psnr_covered:+.2f} dB",
            f"{aligned.gamma:.4f}",
            f"{aligned.mean('psnr_halves_covered'):.2f} dB",
        ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--scale", type=float, default=1.0, help="factor on the image size")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="errors whose name has this in it")
    titles = ["error", "PSNR", "covered", "lost", "γ", "n", "q", "aligned: covered", "lost", "γ", "by halves"]
    for row in (titles, ["---"] * len(titles)):
        print("| " + " | ".join(row) + " |", flush=True)
    for row in rows(parser.parse_args()):
        print("| " + " | ".join(row) + " |", flush=True)


if __name__ == "__main__":
    main()

"""What errors of registration cost, and what alignment leaves of them.

    python benchmarks/registered.py DATA/colon_direct --mesh DATA/colon_direct/truth/colon.ply --scale 0.5

As C3VD is made: photos stay, poses err as a model put into the recorder's frame by hand errs, and depth is of
the true surface at the erring poses through the erring calibration; but in the row that says so it was taken
with the photo, and errs with it. Sizes are exact for motions that all frames share, and root mean squares for
those of each.

Columns: PSNR of the whole and the covered part of held-out photos, as written and aligned; γ of the aligned
twin; errors of all poses, as written and aligned (where depth errs, after the best rigid motion); seconds of
the alignment.
"""

import argparse
import json
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import tifffile
import trimesh
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

import endotwin
from endotwin.align.motion import Path as Recorded
from endotwin.align.trajectory import Apart, compare
from endotwin.sequence import Sequence
from endotwin.sequence.poses import write_c3vd_poses
from endotwin.sequence.readers.c3vd import DEPTH_RANGE_MM
from endotwin.surface import Surface
from endotwin.surface.casting import Caster

DRIFT = 1 / 6
"""Of a sequence, the time in which a drift changes."""

Size = tuple[float, float]
"""Of a motion: mm and degrees."""


@dataclass(frozen=True)
class Wrong:
    """One motion of the ``model`` about the scene, one of the camera on the ``hand``, a clock's ``lag`` in
    frames, a smooth ``drift`` and a ``jitter`` of each frame; ``depth_too``: it was taken with the photo.
    ``intrinsics`` put the written calibration right (see ``Camera.corrected``)."""

    model: Size = (0.0, 0.0)
    hand: Size = (0.0, 0.0)
    lag: float = 0.0
    drift: Size = (0.0, 0.0)
    jitter: Size = (0.0, 0.0)
    depth_too: bool = False
    intrinsics: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def sizes(self, apart: Apart) -> Size:
        """Of what is left; where depth errs, too, of that after the best rigid motion."""
        if self.depth_too:
            return apart.aligned_mm, apart.aligned_deg
        return apart.ate_mm, apart.ate_deg

    def poses(self, T_world_camera: np.ndarray, seed: int) -> np.ndarray:
        """What is written [N, 4, 4] where the camera was at ``T_world_camera`` [N, 4, 4]."""
        rng, count = np.random.default_rng(seed), len(T_world_camera)
        centre = np.eye(4)
        centre[:3, 3] = T_world_camera[:, :3, 3].mean(axis=0)
        slow = gaussian_filter1d(rng.standard_normal((count, 6)), DRIFT * count, axis=0)
        slow -= slow.mean(axis=0)
        own = _motions(slow, self.drift) @ _motions(rng.standard_normal((count, 6)), self.jitter)
        model, hand = (_motions(rng.standard_normal((1, 6)), size)[0] for size in (self.model, self.hand))
        about = centre @ model @ np.linalg.inv(centre)
        return about @ Recorded(T_world_camera).later(self.lag) @ own @ hand


WRONG = {
    "none": Wrong(),
    "one hand-eye error of .32 mm/.16°": Wrong(hand=(0.32, 0.16)),
    "model, hand-eye .13 mm/.08°, lag .15 frame, jitter and drift .06 mm/.03°": Wrong(
        (0.13, 0.08), (0.13, 0.08), 0.15, (0.042, 0.021), (0.042, 0.021)
    ),
    "depth moves with its photo, .3 mm/.15°, mostly drift": Wrong(
        drift=(0.29, 0.145), jitter=(0.08, 0.04), depth_too=True
    ),
    "focal length .5 % short, centre .4 % of the width aside": Wrong(intrinsics=(0.005, 0.004, -0.002)),
    "focal length .4 % short, centre .3 % aside, hand-eye .13 mm/.08°": Wrong(
        hand=(0.13, 0.08), intrinsics=(0.004, 0.003, -0.002)
    ),
}


def _motions(twists: np.ndarray, size: Size) -> np.ndarray:
    """Motions [N, 4, 4] along ``twists`` [N, 6] (turns first), whose root mean squares are ``size``."""
    T = np.tile(np.eye(4), (len(twists), 1, 1))
    turns, shifts = (
        part * (wanted / np.sqrt((part**2).sum(axis=1).mean()))
        for part, wanted in zip((twists[:, :3], twists[:, 3:]), size[::-1], strict=True)
    )
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_rotvec(turns, degrees=True).as_matrix(), shifts
    return T


def written(sequence: Sequence, wrong: Wrong, caster: Caster, folder: Path, seed: int) -> Path:
    """``sequence`` as ``wrong`` poses write it down, as C3VD v1 in ``folder``, which is returned."""
    folder.mkdir()
    camera = sequence.camera.corrected(-np.array(wrong.intrinsics))
    poses = wrong.poses(sequence.T_world_camera, seed)
    forward = camera.pixel_directions[..., 2]
    for index, pose in enumerate(poses):
        depth_mm = np.nan_to_num(sequence.depth_mm(index))
        if not wrong.depth_too:
            hits = caster.cast(camera, pose)
            depth_mm = hits.laid_out(hits.distance_mm, forward.shape) * forward
        raw = np.clip(depth_mm / DEPTH_RANGE_MM * 65535, 0, 65535) + 0.5
        tifffile.imwrite(folder / f"{index:04d}_depth.tiff", raw.astype(np.uint16))
        cv2.imwrite(str(folder / f"{index:04d}_color.png"), sequence.color(index)[..., ::-1])
    (folder / "camera.json").write_text(json.dumps(camera.to_dict()))
    write_c3vd_poses(folder / "pose.txt", poses)
    return folder


def rows(options: argparse.Namespace) -> Iterator[list[str]]:
    """The table, a row an error."""
    sequence = endotwin.open_sequence(options.sequence, scale=options.scale)
    mesh = trimesh.load(options.mesh, process=False)
    caster = Caster(Surface.from_mesh(mesh.vertices, mesh.faces, mesh.vertex_normals))
    for name, wrong in WRONG.items():
        if options.only not in name:
            continue
        with tempfile.TemporaryDirectory() as work:
            fused = endotwin.fuse_twin(written(sequence, wrong, caster, Path(work) / "written", options.seed))
            plain = endotwin.evaluate(endotwin.fit_twin(fused, align="off"))
            twin = endotwin.fit_twin(fused, align="auto")
            aligned = endotwin.evaluate(twin)
            apart = [
                compare(each.sequence().T_world_camera, sequence.T_world_camera) for each in (fused, twin)
            ]
        yield [
            name,
            *(f"{scores.psnr:.1f} / {scores.psnr_covered:.1f}" for scores in (plain, aligned)),
            f"{aligned.gamma:.4f}",
            *(f"{mm:.3f} mm/{deg:.3f}°" for mm, deg in map(wrong.sizes, apart)),
            f"{twin.record['align']['seconds']:.0f} s",
        ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequence", type=Path, help="whose poses are true")
    parser.add_argument("--mesh", type=Path, required=True, help="the true surface, in mm")
    parser.add_argument("--scale", type=float, default=1.0, help="factor on the image size")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="errors whose name has this in it")
    titles = ["error put in", "as written", "aligned", "γ", "poses as written", "aligned", "in"]
    for row in (titles, ["---"] * len(titles)):
        print("| " + " | ".join(row) + " |", flush=True)
    for row in rows(parser.parse_args()):
        print("| " + " | ".join(row) + " |", flush=True)


if __name__ == "__main__":
    main()

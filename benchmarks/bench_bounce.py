"""How well a surface of what was seen knows the light between tissue, against the whole colon.

    python benchmarks/bench_bounce.py --meshes DATA/colon_bounce DATA/colon_gi=DATA/colon_direct --seeds 0,3,9

Each sequence is fused; at vertices that photos saw, indirect irradiance of a light at the lens and an even
albedo is compared with that on the true mesh (``truth/colon.ply`` of the sequence, or of the folder named
after ``=``; the independent renderer's own for a seed), with the wall that closes the lumen and without.

Columns: the ratio of the two in the median; the standard deviation of its logarithm from frame to frame; and
from place to place within a frame (1.48 · the median absolute deviation).
"""

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh

import endotwin
from endotwin.light.guides import COSINE
from endotwin.light.radiosity import Radiosity
from endotwin.surface import Surface
from endotwin.surface.casting import Caster

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from independent.picture import Studio
from independent.scene import Scene
from independent.write import make

N, Q, ALBEDO = 1.5, 2.0, 0.5
CELL_MM = 3.0
FRAMES, PLACES = 8, 4000


def bounced(surface: Surface, points_mm: np.ndarray, normals: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Indirect irradiance [F, N] at world ``points_mm`` [N, 3] under the light of each pose [F, 4, 4]."""
    radiosity = Radiosity(surface, Caster(surface), CELL_MM)
    to_points = radiosity.to_points((points_mm - surface.origin_mm).astype(np.float32), normals)
    lamps = [radiosity.lamp(pose, np.zeros(3), COSINE) for pose in surface.to_local(poses)]
    direct = np.concatenate([radiosity.direct([lamp], N, Q) for lamp in lamps], axis=1)
    found = radiosity.indirect(direct, np.full((radiosity.count, 3), ALBEDO))[: radiosity.count, :, 0]
    return (to_points @ found).T


def report(name: str, folder: Path, vertices_mm: np.ndarray, triangles: np.ndarray) -> None:
    """Print the rows of one sequence, whose whole colon is given."""
    twin, sequence = endotwin.fuse_twin(folder), endotwin.open_sequence(folder)
    surface = twin.surface
    poses = sequence.T_world_camera[np.linspace(0, len(sequence) - 1, FRAMES).round().astype(int)]
    seen = np.random.default_rng(0).choice(np.flatnonzero(surface.seen_by), PLACES)
    points_mm, normals = surface.vertices_mm[seen] + surface.origin_mm, surface.normals[seen]
    whole = Surface.from_mesh(vertices_mm, triangles, np.zeros_like(vertices_mm))
    true = bounced(whole, points_mm, normals, poses)
    bare = replace(surface, wall_mm=surface.wall_mm[:0], wall_triangles=surface.wall_triangles[:0])
    shown = np.stack([_shown(sequence.camera, pose, points_mm) for pose in poses])
    for tag, each in (("with", surface), ("without", bare)):
        ratio = np.log(np.maximum(bounced(each, points_mm, normals, poses), 1e-30) / true)
        ratio[~shown] = np.nan
        frame = np.nanmedian(ratio, axis=1)
        places = 1.4826 * np.nanmedian(np.abs(ratio - frame[:, None]), axis=1).mean()
        print(
            f"| {name} | {tag} | {np.exp(np.nanmedian(ratio)):.3f} | {frame.std():.3f} | {places:.3f} |",
            flush=True,
        )


def _shown(camera, pose: np.ndarray, points_mm: np.ndarray) -> np.ndarray:
    uv = camera.project((points_mm - pose[:3, 3]) @ pose[:3, :3])
    with np.errstate(invalid="ignore"):
        return ((uv > 0) & (uv < (camera.width - 1, camera.height - 1))).all(axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--meshes", nargs="*", default=[], metavar="SEQUENCE[=FOLDER]")
    parser.add_argument("--seeds", default="", help="as 3,7,12")
    parser.add_argument("--work", type=Path, metavar="FOLDER", help="keep the scenes there")
    options = parser.parse_args()
    print("| sequence | wall | ratio | from frame to frame | from place to place |\n|---|---|---|---|---|")
    for given in options.meshes:
        folder, _, other = given.partition("=")
        mesh = trimesh.load(Path(other or folder) / "truth" / "colon.ply", process=False)
        report(Path(folder).name, Path(folder), np.asarray(mesh.vertices), np.asarray(mesh.faces))
    with tempfile.TemporaryDirectory() as scratch:
        for seed in map(int, filter(None, options.seeds.split(","))):
            scene, folder = Scene.draw(seed), (options.work or Path(scratch)) / f"{seed:04d}" / "all"
            make(scene, folder)
            wall = Studio(scene).wall
            report(f"seed {seed}", folder, wall.vertices_mm, wall.triangles)


if __name__ == "__main__":
    main()

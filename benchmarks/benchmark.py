"""What endotwin's accuracy costs: run the pipeline on sequences with truth and print a markdown table.

    python benchmarks/benchmark.py DATA/colon_direct
    python benchmarks/benchmark.py DATA/colon_direct --config draft --config fine
    python benchmarks/benchmark.py DATA/colon_direct --method endopbr --budget 60s
    python benchmarks/benchmark.py DATA/colon_direct --device cuda
    python benchmarks/benchmark.py DATA/colon_bounce --geometry true

Each command runs in its own process from cold files, so that its seconds and its peak memory are its own.
Only this script reads the truth (``truth/``: albedo and roughness of some frames; ``made.json``: the light).
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from itertools import product
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial import cKDTree

sys.path.append(str(Path(__file__).parent))

from decisions import apart_mm

from endotwin.evaluation.evaluation import covered_pixels
from endotwin.fit.solve import median_edge_mm
from endotwin.fusion._open3d import o3d
from endotwin.light.guides import AT_LENS
from endotwin.render import Renderer
from endotwin.surface import Surface
from endotwin.twin import Twin

GAMMA, FALLOFF = 1 / 2.2, 2.0
"""Truth of sequences whose made.json does not tell."""

METHODS = ("twin", "endopbr")

NEAR_EDGES = 2.0
"""A vertex of the true mesh is seen as the nearest fused one is, if that is within so many of its edges."""


def run(*arguments: object, profile: Path) -> tuple[str, float, dict]:
    """One endotwin command: what it printed, its seconds (Python's start included), its profile."""
    command = [sys.executable, "-m", "endotwin.cli.start", *map(str, arguments), "--profile", str(profile)]
    started = time.perf_counter()
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, encoding="utf-8")
    if done.returncode:
        sys.exit(f"{' '.join(command)} failed")
    return done.stdout, time.perf_counter() - started, json.loads(profile.read_text())


def material_errors(twin: Twin, truth: Path) -> tuple[float, float]:
    """RMSE of albedo, after one global scale, and of roughness, over covered pixels of frames with truth; NaN
    without any."""
    files = sorted(truth.glob("*_albedo.png"))
    if not files:
        return float("nan"), float("nan")
    sequence, renderer = twin.source.open(), Renderer(twin)
    fitted_albedo, true_albedo, fitted_roughness, true_roughness = [], [], [], []
    for file in files:
        frame = sequence.frame(int(file.name.split("_")[0]))
        valid = sequence.lens_mask & np.isfinite(frame.depth_mm)
        view = renderer.view(frame.T_world_camera, valid)
        covered = covered_pixels(view.hits, twin.surface, valid.shape)
        size = (valid.shape[1], valid.shape[0])
        albedo = cv2.resize(cv2.imread(str(file))[..., ::-1], size, interpolation=cv2.INTER_AREA) / 255
        fitted_albedo.append(view.image(view.attribute(twin.materials.base_color))[covered])
        true_albedo.append(albedo[covered])
        rough = cv2.imread(str(file).replace("albedo", "roughness"), cv2.IMREAD_GRAYSCALE)
        fitted_roughness.append(view.image(view.attribute(twin.materials.roughness))[covered])
        true_roughness.append(cv2.resize(rough, size, interpolation=cv2.INTER_AREA)[covered] / 255)
    fitted, true = np.concatenate(fitted_albedo).astype(np.float64), np.concatenate(true_albedo)
    scale = (fitted * true).sum() / (fitted * fitted).sum()
    roughness_error = np.concatenate(fitted_roughness) - np.concatenate(true_roughness)
    return float(np.sqrt(np.mean((scale * fitted - true) ** 2))), float(np.sqrt(np.mean(roughness_error**2)))


def on_true_mesh(twin: Twin, truth: Path) -> Twin:
    """The twin with the true mesh, all of it, for its own; seen where a fused vertex was, next to it."""
    mesh = o3d.io.read_triangle_mesh(str(truth)).compute_vertex_normals()
    vertices_mm, triangles, normals = map(np.asarray, (mesh.vertices, mesh.triangles, mesh.vertex_normals))
    fused, true = twin.surface, Surface.from_mesh(vertices_mm, triangles, normals)
    nearest = cKDTree(fused.vertices_mm + fused.origin_mm)
    apart_mm, which = nearest.query(vertices_mm, distance_upper_bound=NEAR_EDGES * median_edge_mm(true))
    near = np.isfinite(apart_mm)
    which[~near] = 0
    seen_by = np.where(near, fused.seen_by[which], 0).astype(np.int32)
    nearest_mm = np.where(seen_by > 0, fused.nearest_mm[which], np.inf).astype(np.float32)
    return replace(twin, surface=true.with_coverage(seen_by, nearest_mm))


def mesh_error(twin: Twin, truth: Path) -> str:
    """Mean distance of the measured vertices from the true mesh, where there is one."""
    if not truth.exists():
        return "-"
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(o3d.io.read_triangle_mesh(str(truth))))
    world_mm = (twin.surface.vertices_mm + twin.surface.origin_mm)[~twin.surface.filled].astype(np.float32)
    return f"{scene.compute_distance(world_mm).numpy().mean():.3f} mm"


def true_light(made: dict) -> dict:
    """γ, n, q and where guides stand, of the scene's description."""
    light = made.get("light", {"n": made.get("spread"), "q": FALLOFF})
    guides_mm = made.get("lights", AT_LENS)
    return {"gamma": made.get("gamma", GAMMA), "n": light["n"], "q": light["q"], "guides_mm": guides_mm}


def guides_apart(twin: Twin, true_mm: list) -> str:
    """Mean distance of the twin's guides from the true ones, if there are as many beside the lens."""
    found_mm = twin.effects.guides_mm or AT_LENS
    if len(found_mm) != len(true_mm):
        return f"{len(found_mm)} of {len(true_mm)}"
    return f"{apart_mm(found_mm, true_mm):.2f} mm" if np.any([found_mm, true_mm]) else "-"


def aligned(twin: Twin) -> str:
    """Seconds that alignment took, and whether it moved anything."""
    record = twin.record.get("align")
    moved = ", moved" if twin.registration is not None else ""
    return "-" if record is None else f"{record['seconds']:.1f} s{moved}"


def percent(value: float, true: float) -> str:
    """Relative error as a signed percentage."""
    return f"{100 * (value / true - 1):+.1f} %"


def benchmark(
    sequence: Path, method: str, config: str, options: argparse.Namespace, work: Path
) -> dict[str, str]:
    """One row of the table."""
    twin_folder, profile = work / f"{sequence.name}-{method}-{Path(config).stem}", work / "profile.json"
    geometry = "known" if options.geometry == "true" else options.geometry
    protocol = ["--config", config, "--geometry", geometry]
    scale = [] if options.scale is None else ["--scale", options.scale]
    budget = [] if options.budget is None else ["--budget", options.budget]
    _, fuse_s, fuse = run(
        "fuse", sequence, "-o", twin_folder, "--overwrite", *protocol, *scale, profile=profile
    )
    if options.geometry == "true":
        true = on_true_mesh(Twin.load(twin_folder), sequence / "truth" / "colon.ply")
        true.save(twin_folder, overwrite=True)
    learn = ["--method", method, "--config", config, *budget, "--seed", options.seed]
    learn += ["--device", options.device]
    _, fit_s, fit = run("fit", twin_folder, *learn, profile=profile)
    printed, eval_s, _ = run("eval", twin_folder, "--json", "--scale", 1, profile=profile)
    scores, twin = json.loads(printed), Twin.load(twin_folder)
    albedo, roughness = material_errors(twin, sequence / "truth")
    truth = true_light(json.loads((sequence / "truth" / "made.json").read_text()))
    named = [method, config if method == "twin" else None, options.budget]
    named.append(None if options.device == "cpu" else options.device)
    return {
        "sequence": sequence.name,
        "method": ", ".join(filter(None, named)),
        "geometry": options.geometry,
        "fuse": f"{fuse_s:.1f} s",
        "fit": f"{fit_s:.1f} s",
        "of it align": aligned(twin),
        "fuse + fit": f"{fuse_s + fit_s:.1f} s",
        "eval": f"{eval_s:.1f} s",
        "peak memory": f"{max(fuse['peak_memory_mb'], fit['peak_memory_mb']) / 1000:.2f} GB",
        "PSNR": f"{scores['psnr']:.2f} dB",
        "SSIM": f"{scores['ssim']:.4f}",
        "PSNR covered": f"{scores['psnr_covered']:.2f} dB",
        "covered": f"{100 * scores['covered']:.1f} %",
        "γ": percent(scores["gamma"], truth["gamma"]),
        "n": percent(scores["light"]["n"], truth["n"]),
        "q": percent(scores["light"]["q"], truth["q"]),
        "guides": guides_apart(twin, truth["guides_mm"]),
        "albedo RMSE": "-" if np.isnan(albedo) else f"{albedo:.4f}",
        "roughness RMSE": "-" if np.isnan(roughness) else f"{roughness:.4f}",
        "mesh": mesh_error(twin, sequence / "truth" / "colon.ply"),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequence", nargs="+", type=Path, help="sequence folders with a truth/ folder")
    parser.add_argument("--method", action="append", choices=METHODS, help="may be repeated (default: twin)")
    parser.add_argument("--config", action="append", help="may be repeated (default: standard)")
    parser.add_argument("--budget", help="time of each fit, as 60s or 10m (default: the config's)")
    parser.add_argument("--geometry", default="known", choices=("known", "heldout", "true"))
    parser.add_argument("--scale", type=float, help="factor on the image size (default: the config's)")
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"), help="that fits (default: cpu)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep the twins there")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        work = options.keep or Path(temporary)
        work.mkdir(parents=True, exist_ok=True)
        header_printed = False
        for sequence in options.sequence:
            ways = product(options.method or ["twin"], options.config or ["standard"])
            for method, config in ways:
                row = benchmark(sequence, method, config, options, work)
                if not header_printed:
                    print("| " + " | ".join(row) + " |\n|" + "---|" * len(row), flush=True)
                    header_printed = True
                print("| " + " | ".join(row.values()) + " |", flush=True)


if __name__ == "__main__":
    main()

"""What other programs show of a twin: ``python benchmarks/bench_export.py TWIN [--blender PYTHON]``.

Each format is written, timed and measured; then Mitsuba 3 (pip install mitsuba), a browser (chromium) and
Blender (a Python that has bpy) draw held-out poses, and their pictures are compared with endotwin's through
the same pinhole camera: PSNR in dB over the pixels that see the surface. Blender's exposure is free.
Khronos' validator needs node and NODE_PATH.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np

from endotwin.cameras.perspective import as_pinhole
from endotwin.evaluation.metrics import psnr
from endotwin.export import FORMATS
from endotwin.export.mitsuba import matrix
from endotwin.twin import Twin

VALIDATE = """
require("gltf-validator").validateBytes(new Uint8Array(require("fs").readFileSync(process.argv[1])))
.then(report => console.log(JSON.stringify(report.issues)))"""

BLENDER = """
import bpy, sys
glb, out, width, height, *seconds = sys.argv[1:]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=glb)
scene = bpy.context.scene
scene.camera = next(each for each in bpy.data.objects if each.type == "CAMERA")
scene.render.engine, scene.cycles.samples, scene.cycles.max_bounces = "CYCLES", 16, 0
scene.render.resolution_x, scene.render.resolution_y = int(width), int(height)
scene.render.resolution_percentage = 100
scene.view_settings.view_transform = "Raw"
scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
for number, second in enumerate(seconds):
    frame = float(second) * scene.render.fps
    scene.frame_set(int(frame), subframe=frame % 1)
    scene.render.filepath = f"{out}/{number}.exr"
    bpy.ops.render.render(write_still=True)
"""

Draw = Callable[[np.ndarray, int], np.ndarray]
"""``draw(T_world_camera, frame)``: the picture as displayed, [H, W, 3]."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("twin", type=Path)
    parser.add_argument("--blender", type=Path, help="a Python that has bpy")
    parser.add_argument("--poses", type=int, default=3)
    arguments = parser.parse_args()
    twin = Twin.load(arguments.twin)
    twin = replace(twin, effects=twin.effects.without(["sparkle"]))
    poses = twin.sequence().T_world_camera
    heldout = twin.source.heldout(len(poses))
    frames = [heldout[i] for i in np.linspace(0, len(heldout) - 1, arguments.poses).astype(int)]
    with tempfile.TemporaryDirectory() as folder:
        here = [suffix for suffix in FORMATS if suffix != ".usdz" or find_spec("pxr")]
        files = {suffix: Path(folder) / f"twin{suffix}" for suffix in here}
        for suffix, file in files.items():
            began = time.perf_counter()
            twin.export(file)
            size = sum(each.stat().st_size for each in ([file] if file.is_file() else file.iterdir()))
            print(f"{suffix}: {size / 1e6:.1f} MB in {time.perf_counter() - began:.1f} s")
        if shutil.which("node"):
            validate(files[".glb"])
        if find_spec("mitsuba"):
            compare("Mitsuba 3", twin, poses, frames, in_mitsuba(twin, files[".mitsuba"]))
        if browser := shutil.which("chromium") or shutil.which("google-chrome"):
            compare("browser", twin, poses, frames, in_browser(twin, browser, files[".html"]))
        if arguments.blender:
            draw = in_blender(twin, arguments.blender, files[".glb"], poses, frames)
            compare("Blender", twin, poses, frames, draw)


def compare(name: str, twin: Twin, poses: np.ndarray, frames: list[int], draw: Draw) -> None:
    """Print how well ``draw`` agrees with endotwin."""
    scores = []
    for frame in frames:
        view = twin.render(poses[frame], as_pinhole(twin.camera))
        scores.append(f"frame {frame} {psnr(draw(poses[frame], frame), view.color, view.mask):.1f} dB")
    print(f"{name}: {', '.join(scores)}")


def validate(glb: Path) -> None:
    done = subprocess.run(["node", "-e", VALIDATE, glb], capture_output=True, text=True)
    if done.returncode == 0:
        issues = json.loads(done.stdout)
        print(f"glTF validator: {issues['numErrors']} errors, {issues['numWarnings']} warnings")


def in_mitsuba(twin: Twin, folder: Path) -> Draw:
    import mitsuba

    mitsuba.set_variant("scalar_rgb")

    def draw(pose: np.ndarray, frame: int) -> np.ndarray:
        scene = mitsuba.load_file(str(folder / "scene.xml"), pose=matrix(pose), spp=16)
        return np.clip(np.array(mitsuba.render(scene))[..., :3], 0, 1) ** twin.response.gamma

    return draw


def in_browser(twin: Twin, browser: str, page: Path) -> Draw:
    quiet = ["--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    quiet += ["--hide-scrollbars", "--force-device-scale-factor=1", "--virtual-time-budget=10000"]
    seen = page.with_suffix(".png")

    def draw(pose: np.ndarray, frame: int) -> np.ndarray:
        size = f"--window-size={twin.camera.width},{twin.camera.height}"
        own = [size, f"--user-data-dir={page.parent / 'browser'}", f"--screenshot={seen}"]
        command = [browser, *quiet, *own, f"file://{page}#along={frame}&bare"]
        subprocess.run(command, capture_output=True, check=True)
        return cv2.imread(str(seen))[..., ::-1] / 255

    return draw


def in_blender(twin: Twin, python: Path, glb: Path, poses: np.ndarray, frames: list[int]) -> Draw:
    import OpenEXR

    from endotwin.export.glb import PATH_FPS

    size = [str(twin.camera.width), str(twin.camera.height)]
    seconds = [str(frame / PATH_FPS) for frame in frames]
    command = [python, "-c", BLENDER, glb, glb.parent, *size, *seconds]
    subprocess.run(command, capture_output=True, check=True)

    def draw(pose: np.ndarray, frame: int) -> np.ndarray:
        with OpenEXR.File(str(glb.parent / f"{frames.index(frame)}.exr")) as file:
            channels = file.channels()
            radiance = (channels.get("RGBA") or channels["RGB"]).pixels[..., :3]
        view = twin.render(pose, as_pinhole(twin.camera))
        seen = view.mask & (radiance.min(axis=2) > 0)
        exposure = np.median(view.radiance[seen] / radiance[seen])
        return np.clip(exposure * radiance, 0, 1) ** twin.response.gamma

    return draw


if __name__ == "__main__":
    main()

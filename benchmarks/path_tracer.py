"""Scenes with everything at once, path-traced from procedural colons: each is all that its seed draws.

    pip install mitsuba    # and LLVM 16 or later, which DRJIT_LIBLLVM_PATH names where it is not found
    python benchmarks/path_tracer.py 2 4 7 -o scenes
    python benchmarks/path_tracer.py --kind wet 905 -o scenes

Colon and path are those of examples/make_colon_small.py. Light guides, bounces to the sixteenth, a clear
coat, vignetting, a gain that meters each photo, defocus, noise, and what a video processor does to a photo,
tone curve, sharpening, chroma at half size and JPEG, each come by chance; so do poses that err as a
registration does, with depth of the true surface there. All scenes of a ``--kind`` have the same few of
these, and only colon and path from their seed. ``truth/made.json`` says what a scene has. Of endotwin there
is nothing in it but the casting of depth maps. A scene takes some ten minutes.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import tifffile

from endotwin.cameras import camera_from_dict
from endotwin.sequence.poses import write_c3vd_poses
from endotwin.sequence.readers.c3vd import DEPTH_RANGE_MM
from endotwin.surface import Surface
from endotwin.surface.casting import Caster

sys.path.extend(str(Path(__file__).parents[1] / name) for name in ("benchmarks", "examples", "tests"))

from independent.lens import Lens
from registered import Wrong

GAMMA = 1 / 2.2
GUIDES_MM = {
    1: [[0.0, 0.0, 0.0]],
    2: [[2.5, 0.0, 0.0], [-2.5, 1.0, 0.0]],
    3: [[3.24, 0.55, 0.0], [-2.77, 2.66, 0.0], [-1.27, -3.14, 0.0]],
}
SPLIT = 3
"""Each pixel is the mean of so many times so many rays."""

PATHS = 20
"""Paths of bounced light a pixel: five left it uneven by 15 %, far off by 24 %, which hid guides."""

BRIGHTEST = 0.9995
"""Quantile of bounced light at which it is cut: single paths of much light are noise."""

REGISTERED = Wrong((0.13, 0.08), (0.13, 0.08), 0.05, (0.042, 0.021), (0.042, 0.021))
"""As of ``colon_scope_registered``, but for the lag: this path turns faster."""


@dataclass(frozen=True)
class Draw:
    """What a scene has. An effect is off where its number is 0 or it is False.

    Attributes:
        shape: of the colon. tint: factors on its red, green and blue. n: of the light. bounces: of light.
            vignetting: k of e^{−k r²}, r = 1 at half the width. coat, gloss: Mitsuba's clear coat. tone:
            contrast of a smooth step. defocus: pixels. noise: in 1/255. jpeg: quality.
    """

    seed: int
    shape: dict
    tint: list[float]
    lens: Lens
    guides_mm: list[list[float]]
    n: float
    bounces: int
    gain: bool
    vignetting: float
    coat: float
    gloss: float
    defocus: float
    noise: float
    tone: float
    sharpened: float
    chroma: bool
    jpeg: int
    registered: bool
    frames: int
    step_mm: float
    start_mm: float

    @classmethod
    def of(cls, seed: int) -> Draw:
        rng = np.random.default_rng([seed, 99])

        def number(low: float, high: float, chance: float = 1.0) -> float:
            value, there = float(rng.uniform(low, high)), rng.random() < chance
            return value if there else 0.0

        shape = {name: number(*span) for name, span in SHAPE.items()}
        count = int(rng.choice([1, 2, 3, 3]))
        aside = rng.uniform(-0.4, 0.4, (count, 3)) * [1, 1, 0] * (count > 1)
        return cls(
            seed=seed,
            shape=shape,
            tint=rng.uniform([0.8, 0.7, 0.7], [1.25, 1.4, 1.4]).tolist(),
            lens=Lens.omni(270) if rng.random() < 0.6 else Lens.pinhole(320, 240, 80),
            guides_mm=(np.array(GUIDES_MM[count]) + aside).tolist(),
            n=number(1, 2.3),
            bounces=16 if rng.random() < 0.65 else 0,
            gain=bool(rng.random() < 0.5),
            vignetting=number(0.12, 0.35, 0.5),
            coat=number(0.8, 2, 0.4),
            gloss=number(0.9, 0.99),
            defocus=number(0.4, 0.9, 0.3),
            noise=number(0.7, 2.5),
            tone=number(0.25, 0.5, 0.5),
            sharpened=number(0.2, 0.7, 0.4),
            chroma=bool(rng.random() < 0.5),
            jpeg=int(rng.integers(84, 97)) * int(rng.random() < 0.6),
            registered=bool(rng.random() < 0.4),
            frames=int(rng.integers(20, 33)),
            step_mm=number(0.5, 0.9),
            start_mm=number(10, 30),
        )

    @classmethod
    def of_kind(cls, kind: str, seed: int) -> Draw:
        drawn = cls.of(seed)
        return replace(KINDS[kind], seed=seed, shape=drawn.shape, start_mm=drawn.start_mm)

    @property
    def effects(self) -> list[str]:
        """endotwin's names of what the scene has."""
        beside = len(self.guides_mm) > 1
        there = {"offset": beside, "shadows": beside, "interreflection": self.bounces, "gain": self.gain}
        there |= {"vignetting": self.vignetting, "coat": self.coat, "tone": self.tone}
        return [name for name, value in there.items() if value]


PLAIN = Draw(
    seed=0,
    shape={},
    tint=[1.0, 1.0, 1.0],
    lens=Lens.omni(270),
    guides_mm=GUIDES_MM[1],
    n=2.0,
    bounces=0,
    gain=False,
    vignetting=0.0,
    coat=0.0,
    gloss=0.9,
    defocus=0.0,
    noise=1.0,
    tone=0.0,
    sharpened=0.0,
    chroma=False,
    jpeg=0,
    registered=False,
    frames=22,
    step_mm=0.9,
    start_mm=0.0,
)
SCOPE = replace(PLAIN, guides_mm=GUIDES_MM[3], n=1.4, vignetting=0.2, gain=True, noise=1.5)
PROCESSED = replace(PLAIN, sharpened=0.5, tone=0.35, jpeg=88)
KINDS = {
    "bounce": replace(PLAIN, lens=Lens.pinhole(400, 300, 80), bounces=5),
    "processed": replace(PROCESSED, lens=Lens.pinhole(640, 480, 80), frames=30, step_mm=0.7),
    "film": replace(SCOPE, bounces=16, coat=1.5, gloss=0.97, frames=26, step_mm=0.8),
    "wet": replace(SCOPE, lens=Lens.omni(405), coat=2.0, gloss=0.99, frames=28, step_mm=0.4),
}
"""Light of four bounces; photos of a processor; a scope in a colon with a film of water; wet walls without
bounces."""

SHAPE = {
    "radius_mm": (9, 16),
    "bend_radius_mm": (35, 80),
    "fold_spacing_mm": (7, 13),
    "fold_height_mm": (2, 4.5),
    "fold_width_mm": (1.4, 2.4),
}


class Studio:
    """Mitsuba's scene of a colon and its guides, which go with the camera."""

    def __init__(self, drawn: Draw):
        import make_colon_small as colons
        import mitsuba as mi

        mi.set_variant("llvm_ad_rgb")
        colon = colons.Colon(length_mm=120.0, edge_mm=0.2, polyps=(), **drawn.shape)
        places = colons.wall_grid(colon, drawn.seed)
        vertices, self._triangles, normals = colons.wall_mesh(colon, drawn.seed, *places)
        albedo, roughness = colons.mucosa(colon, drawn.seed, *places)
        self._albedo = np.clip(albedo.reshape(-1, 3) * drawn.tint, 0.02, 0.95)
        self.surface = Surface.from_mesh(vertices, self._triangles, normals)
        self.caster = Caster(self.surface)
        self.camera = camera_from_dict(drawn.lens.to_dict(), Path("camera.json"))
        self.poses = colons.fly_through(colon, drawn.frames, drawn.step_mm, drawn.start_mm)
        coat = {"clearcoat": drawn.coat, "clearcoat_gloss": drawn.gloss} if drawn.coat else {}
        mesh = colons.tissue_mesh(vertices, self._triangles, normals, self._albedo, roughness, **coat)
        guide = _guide(mi)
        self._guides = [mi.load_dict({"type": guide, "n": drawn.n}) for _ in drawn.guides_mm]
        # Of several lights a path takes one by chance: direct light is without noise from one at a time.
        self._alone = [mi.load_dict({"type": "scene", "colon": mesh, "guide": each}) for each in self._guides]
        every = {f"guide{k}": each for k, each in enumerate(self._guides)}
        self._scene = mi.load_dict({"type": "scene", "colon": mesh, **every})
        self._direct = mi.load_dict({"type": "path", "max_depth": 2})
        self._all = mi.load_dict({"type": "path", "max_depth": max(2, drawn.bounces), "rr_depth": 4})
        self._mi, self._drawn = mi, drawn

    def radiance(self, frame: int) -> np.ndarray:
        """Of one photo, for L0 = 1, [H, W, 3]."""
        drawn, T, lens = self._drawn, self.poses[frame], self._drawn.lens
        for guide, at_mm in zip(self._guides, drawn.guides_mm, strict=True):
            guide.place(T[:3, :3] @ at_mm + T[:3, 3], T[:3, 2])
        v, u = np.indices((lens.height, lens.width)).reshape(2, -1)
        rng = np.random.default_rng([drawn.seed, 5, frame])
        direct, bounced, paths = 0.0, 0.0, PATHS if drawn.bounces else 0
        for ray in range(max(SPLIT**2, paths)):
            aside = (np.array([ray % SPLIT, ray // SPLIT % SPLIT]) + rng.random((len(u), 2))) / SPLIT - 0.5
            world = lens.rays(u + aside[:, 0], v + aside[:, 1]) @ T[:3, :3].T
            seed = int(rng.integers(2**31))
            if ray < SPLIT**2:
                direct = direct + sum(self._shot(self._direct, each, T, world, seed) for each in self._alone)
            if ray < paths:
                both = (self._shot(each, self._scene, T, world, seed) for each in (self._all, self._direct))
                bounced = bounced + np.subtract(*both) / paths
        image = direct.reshape(lens.height, lens.width, 3) / SPLIT**2
        return image + self._smoothed(bounced, T) if drawn.bounces else image

    def _shot(
        self, integrator, scene, T_world_camera: np.ndarray, world: np.ndarray, seed: int
    ) -> np.ndarray:
        """Radiance [N, 3] along rays [N, 3] from a camera; what changes is opaque, so that one kernel does
        for all."""
        import drjit as dr

        mi = self._mi
        origin, number = mi.Point3f(*map(float, T_world_camera[:3, 3])), mi.UInt32(seed)
        dr.make_opaque(origin, number)
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(number, len(world))
        ray = mi.RayDifferential3f(mi.Ray3f(origin, mi.Vector3f(np.float32(world.T))))
        found = np.array(dr.ravel(integrator.sample(scene, sampler, ray)[0])).reshape(-1, 3)
        return np.nan_to_num(found, posinf=0, neginf=0)

    def _smoothed(self, bounced: np.ndarray, T_world_camera: np.ndarray) -> np.ndarray:
        """Bounced light [H, W, 3] without the noise of few paths: what lights a place is smooth along the
        surface, unlike its colour."""
        lens, hits = self._drawn.lens, self.caster.cast(self.camera, T_world_camera)
        shape = (lens.height, lens.width)
        seen = hits.laid_out(hits.distance_mm, shape) > 0
        corners = self._triangles[np.where(seen, hits.laid_out(hits.triangle, shape), 0).astype(int)]
        at_mm = (
            self.surface.vertices_mm[corners].mean(axis=2) + self.surface.origin_mm - T_world_camera[:3, 3]
        )
        color = np.where(seen[..., None], self._albedo[corners].mean(axis=2), 1)
        light = bounced.reshape(*shape, 3) / color
        light = np.minimum(light, np.quantile(light, BRIGHTEST)).astype(np.float32)
        return color * cv2.ximgproc.jointBilateralFilter(np.float32(at_mm), light, 13, 1.2, 3.0)

    def depth_mm(self, T_world_camera: np.ndarray) -> np.ndarray:
        """Z-depth [H, W] there, 0 for none."""
        forward = self.camera.pixel_directions[..., 2]
        hits = self.caster.cast(self.camera, T_world_camera)
        return np.nan_to_num(hits.laid_out(hits.distance_mm, forward.shape) * forward)


def _guide(mi) -> str:
    """Register a light of cosⁿθ about an axis and 1/d², and return its name."""
    import drjit as dr

    class Guide(mi.Emitter):
        def __init__(self, props):
            mi.Emitter.__init__(self, props)
            self.n, self.m_flags = props["n"], mi.EmitterFlags.DeltaPosition

        def place(self, at_mm, axis) -> None:
            self.at_mm, self.axis = mi.Point3f(*map(float, at_mm)), mi.Vector3f(*map(float, axis))
            dr.make_opaque(self.at_mm, self.axis)

        def sample_direction(self, it, sample, active=True):
            found = dr.zeros(mi.DirectionSample3f)
            found.p, found.time, found.pdf, found.delta = self.at_mm, it.time, 1.0, mi.Bool(True)
            found.emitter = mi.EmitterPtr(self)
            towards = self.at_mm - it.p
            found.dist = dr.norm(towards)
            found.d = towards / found.dist
            cos = dr.maximum(-dr.dot(found.d, self.axis), 0.0)
            return found, mi.Color3f(dr.power(cos, self.n) / dr.square(found.dist)) & active

        def pdf_direction(self, it, found, active=True):
            return mi.Float(0)

        def eval(self, si, active=True):
            return mi.Color3f(0)

        def bbox(self):
            return mi.ScalarBoundingBox3f()

    mi.register_emitter("guide", Guide)
    return "guide"


def photographed(radiance: np.ndarray, gain: float, drawn: Draw, rng: np.random.Generator) -> np.ndarray:
    """What the camera and its processor make of radiance [H, W, 3]: uint8 [H, W, 3], RGB."""
    linear = np.clip(radiance * gain, 0, 1)
    if drawn.defocus:
        linear = cv2.GaussianBlur(linear, (0, 0), drawn.defocus)
    shown = np.clip(linear**GAMMA + rng.normal(0, drawn.noise / 255, linear.shape), 0, 1)
    v, u = np.indices(shown.shape[:2])
    shown[~drawn.lens.lit(u, v)] = 0
    if drawn.sharpened:
        shown = np.clip(shown + drawn.sharpened * (shown - cv2.GaussianBlur(shown, (0, 0), 1.2)), 0, 1)
    shown = shown + drawn.tone * (3 * shown**2 - 2 * shown**3 - shown)
    photo = np.uint8(255 * shown + 0.5)
    if drawn.chroma:
        size, apart = photo.shape[1::-1], cv2.cvtColor(photo, cv2.COLOR_RGB2YCrCb)
        half = cv2.resize(apart[..., 1:], (size[0] // 2, size[1] // 2), interpolation=cv2.INTER_AREA)
        apart[..., 1:] = cv2.resize(half, size, interpolation=cv2.INTER_LINEAR)
        photo = cv2.cvtColor(apart, cv2.COLOR_YCrCb2RGB)
    if drawn.jpeg:
        code = cv2.imencode(".jpg", photo[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, drawn.jpeg])[1]
        photo = cv2.imdecode(code, cv2.IMREAD_COLOR)[..., ::-1]
    return photo


def gains(radiance: np.ndarray, drawn: Draw, rng: np.random.Generator) -> np.ndarray:
    """Factors [N] on radiance [N, H, W, 3]: one for all, or of a meter that hits each photo within 3 %."""
    if not drawn.gain:
        return np.full(len(radiance), 1 / np.quantile(radiance.max(axis=-1), 0.99))
    metered = 0.5 ** (1 / GAMMA) / np.quantile(radiance[..., 0], 0.6, axis=(1, 2))
    return metered * rng.lognormal(0, 0.03, len(radiance))


def make(drawn: Draw, folder: Path, progress: Callable[[int], None] = lambda frame: None) -> None:
    """Render a scene into ``folder``, in C3VD's layout, with its truth."""
    studio, rng = Studio(drawn), np.random.default_rng([drawn.seed, 4])
    (folder / "truth").mkdir(parents=True)
    radiance = []
    for frame in range(drawn.frames):
        radiance.append(studio.radiance(frame).astype(np.float32))
        progress(frame)
    v, u = np.indices((drawn.lens.height, drawn.lens.width))
    centre, half = drawn.lens.parameters, drawn.lens.width / 2
    r2 = ((u - centre["cx"]) ** 2 + (v - centre["cy"]) ** 2) / half**2
    radiance = np.stack(radiance) * np.exp(-drawn.vignetting * r2)[..., None]
    factors = gains(radiance, drawn, rng)
    written = REGISTERED.poses(studio.poses, drawn.seed) if drawn.registered else studio.poses
    for frame, pose in enumerate(written):
        photo = photographed(radiance[frame], factors[frame], drawn, rng)
        raw = np.clip(studio.depth_mm(pose) / DEPTH_RANGE_MM * 65535 + 0.5, 0, 65535).astype(np.uint16)
        cv2.imwrite(str(folder / f"{frame:04d}_color.png"), photo[..., ::-1])
        tifffile.imwrite(folder / f"{frame:04d}_depth.tiff", raw)
    write_c3vd_poses(folder / "pose.txt", written)
    write_c3vd_poses(folder / "truth" / "pose.txt", studio.poses)
    (folder / "camera.json").write_text(json.dumps(drawn.lens.to_dict()) + "\n")
    made = asdict(drawn) | {"lens": drawn.lens.to_dict(), "effects": drawn.effects, "gamma": GAMMA, "q": 2.0}
    made["gains"] = (factors / factors.mean()).tolist()
    (folder / "truth" / "made.json").write_text(json.dumps(made, indent=1) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("seeds", type=int, nargs="+")
    parser.add_argument("--kind", choices=KINDS, default="", help="rather than what each seed draws")
    parser.add_argument("-o", "--output", type=Path, required=True, help="where each makes a folder")
    options = parser.parse_args()
    for seed in options.seeds:
        folder = options.output / f"{options.kind}{seed:04d}"
        drawn = Draw.of_kind(options.kind, seed) if options.kind else Draw.of(seed)
        if folder.exists():
            print(f"{folder} exists already and is left as it is")
            continue
        beside = folder.with_name(f"{folder.name}.partial")
        shutil.rmtree(beside, ignore_errors=True)
        make(drawn, beside, lambda frame, n=drawn.frames: print(f"{frame + 1} of {n}", end="\r", flush=True))
        beside.rename(folder)
        print(f"{folder}: {' '.join(drawn.effects) or 'none'}{', registered' * drawn.registered}")


if __name__ == "__main__":
    main()

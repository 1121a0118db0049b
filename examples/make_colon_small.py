"""Render a small colonoscopy in C3VD v1's layout from a procedural colon, with Mitsuba 3.

    pip install mitsuba
    python examples/make_colon_small.py -o colon_small [--frames 24 --width 320 --height 240 --seed 7]

The scene is a bent tube with haustral folds and two polyps. Albedo (mottled mucosa with vessels) and
roughness live on the vertices of a dense mesh under Mitsuba's principled BSDF. One light sits at the lens:
intensity·cos²θ/d², θ from the optical axis. The camera answers with lin^(1/2.2) and Gaussian noise.
Only direct light is rendered.

To make another scene, alter the numbers in `Colon` and `Camera`, or the functions `lumen_radius_mm` (the
shape), `mucosa` (the materials) and `fly_through` (the camera path). The same arguments give the same bytes.

Lengths are in millimetres. Camera frames follow OpenCV (x right, y down, z forward), pixel centres are at
integers. A point of the wall is named by (s, phi): the length along the centreline and the angle about it.
"""

import argparse
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import mitsuba as mi
import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.spatial import cKDTree

mi.set_variant("scalar_rgb")

DEPTH_RANGE_MM = 100.0
GAMMA = 1 / 2.2
TRUTH_EVERY = 8
TIFF_DEFLATE, TIFF_HORIZONTAL = 8, 2


@dataclass(frozen=True)
class Colon:
    """The shape of the lumen and the density of its mesh."""

    length_mm: float = 84.0
    radius_mm: float = 12.0
    bend_radius_mm: float = 44.0
    fold_spacing_mm: float = 9.0
    fold_height_mm: float = 3.6
    fold_width_mm: float = 1.7
    polyps: tuple = ((27.0, 2.0, 2.6, 3.2), (33.0, 3.6, 2.0, 2.4))  # s, phi, radius, height of each
    edge_mm: float = 0.15


@dataclass(frozen=True)
class Camera:
    """A pinhole camera at the image size, with the response's noise in levels of the 8-bit image."""

    width: int = 320
    height: int = 240
    focal_widths: float = 0.6
    noise_levels: float = 1.0

    def to_json(self) -> dict:
        """The content of camera.json: focal length and centre in pixels."""
        focal_px = self.focal_widths * self.width
        centre = {"cx": (self.width - 1) / 2, "cy": (self.height - 1) / 2}
        return {
            "model": "pinhole",
            "width": self.width,
            "height": self.height,
            "fx": focal_px,
            "fy": focal_px,
            **centre,
        }

    def cos2(self) -> np.ndarray:
        """cos²θ of each pixel's viewing direction from the optical axis, [height, width]."""
        u, v = np.meshgrid(
            np.arange(self.width) - (self.width - 1) / 2, np.arange(self.height) - (self.height - 1) / 2
        )
        return 1 / (1 + (u**2 + v**2) / (self.focal_widths * self.width) ** 2)


def centreline(colon: Colon, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points [N, 3] and frames [N, 3, 3] (columns right, down, forward) of the centreline at ``s`` [N]."""
    fine = np.linspace(0, colon.length_mm, 4001)
    yaw, pitch = fine / colon.bend_radius_mm, 0.25 * np.sin(fine / 16)
    forward = np.stack([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)], axis=1)
    line = cumulative_trapezoid(forward, fine, axis=0, initial=0)
    at = [np.stack([np.interp(s, fine, curve[:, k]) for k in range(3)], axis=1) for curve in (line, forward)]
    z = at[1] / np.linalg.norm(at[1], axis=1, keepdims=True)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return at[0], np.stack([x, np.cross(z, x), z], axis=2)


def smooth_field(
    rng: np.random.Generator, s: np.ndarray, phi: np.ndarray, wavelength_mm: float, radius_mm: float
):
    """A smooth random function of the wall, of unit variance, periodic in ``phi``: 48 plane waves."""
    field = np.zeros(np.broadcast_shapes(s.shape, phi.shape))
    for heading, phase, stretch in rng.uniform([0, 0, 0.7], [2 * np.pi, 2 * np.pi, 1.5], (48, 3)):
        k = 2 * np.pi / (wavelength_mm * stretch)
        field += np.cos(k * np.cos(heading) * s + np.round(k * np.sin(heading) * radius_mm) * phi + phase)
    return field / np.sqrt(24)


def lumen_radius_mm(colon: Colon, seed: int, s: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Distance from the centreline to the wall: a rounded triangle, less folds, less polyps."""
    rng = np.random.default_rng([seed, 1])
    radius = colon.radius_mm * (1 + 0.05 * np.cos(3 * phi + 0.4) + 0.02 * np.cos(phi - s / 15))
    radius = radius + 0.22 * smooth_field(rng, s, phi, 12.0, colon.radius_mm)
    radius += 0.018 * smooth_field(rng, s, phi, 2.2, colon.radius_mm)
    for place in np.arange(0.5, colon.length_mm / colon.fold_spacing_mm):
        jitter, height, lobe, tilt, tilt_phi = rng.uniform(
            [-0.15, 0.8, 0, 0.3, 0], [0.15, 1.2, 2 * np.pi, 1.6, 2 * np.pi]
        )
        x = s - colon.fold_spacing_mm * (place + jitter) - tilt * np.cos(phi - tilt_phi)
        crescent = 0.62 + 0.23 * np.cos(3 * phi + np.pi + 0.4) + 0.15 * np.cos(phi - lobe)
        radius -= colon.fold_height_mm * height * crescent * np.exp(-((x / colon.fold_width_mm) ** 2))
    for polyp_s, polyp_phi, size, height in colon.polyps:
        radius -= height * np.exp(-((polyp_distance_mm(colon, s, phi, polyp_s, polyp_phi) / size) ** 4))
    return radius


def polyp_distance_mm(
    colon: Colon, s: np.ndarray, phi: np.ndarray, polyp_s: float, polyp_phi: float
) -> np.ndarray:
    """Distance along the unrolled wall from a polyp's centre."""
    turn = (phi - polyp_phi + np.pi) % (2 * np.pi) - np.pi
    return np.hypot(s - polyp_s, 0.85 * colon.radius_mm * turn)


def wall_grid(colon: Colon, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Grid lines ``s`` [M, 1] and ``phi`` [1, N] ``edge_mm`` apart, along the folds' flanks too."""
    s = np.arange(0, colon.length_mm, 0.05)[:, None]
    slope = np.gradient(lumen_radius_mm(colon, seed, s, np.linspace(0, 2 * np.pi, 48)[None]), s[:, 0], axis=0)
    path_mm = cumulative_trapezoid(np.hypot(1, slope).mean(axis=1), s[:, 0], initial=0)
    even = np.linspace(0, path_mm[-1], int(path_mm[-1] / colon.edge_mm))
    around = np.arange(int(2 * np.pi * colon.radius_mm / colon.edge_mm)) * colon.edge_mm / colon.radius_mm
    return np.interp(even, path_mm, s[:, 0])[:, None], around[None] * (2 * np.pi / (around[-1] + around[1]))


def wall_mesh(
    colon: Colon, seed: int, s: np.ndarray, phi: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices [M·N, 3], triangles [F, 3] and unit normals [M·N, 3] that point into the lumen."""
    centre, frame = centreline(colon, s[:, 0])
    outward = np.cos(phi)[..., None] * frame[:, None, :, 0] + np.sin(phi)[..., None] * frame[:, None, :, 1]
    points = centre[:, None] + lumen_radius_mm(colon, seed, s, phi)[..., None] * outward
    triangles = grid_triangles(*points.shape[:2])
    vertices = points.reshape(-1, 3)
    a, b, c = vertices[triangles].swapaxes(0, 1)
    doubled_area = np.cross(b - a, c - a)
    sums = [np.bincount(triangles.T.ravel(), np.tile(doubled_area[:, k], 3), len(vertices)) for k in range(3)]
    normals = np.stack(sums, axis=1)
    return vertices, triangles, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def grid_triangles(rows: int, columns: int) -> np.ndarray:
    """Triangles [F, 3] of a grid that closes on itself from the last column to the first."""
    corner = np.arange(rows * columns).reshape(rows, columns)
    right = np.roll(corner, -1, axis=1)
    a, b, c, d = corner[:-1], right[:-1], corner[1:], right[1:]
    return np.concatenate([np.stack([a, c, b], -1).reshape(-1, 3), np.stack([b, c, d], -1).reshape(-1, 3)])


def vessel_tree(
    rng: np.random.Generator, start: np.ndarray, heading: float, width_mm: float
) -> list[np.ndarray]:
    """A branching random walk on the unrolled wall: rows of (along, around, width), all in mm."""
    rows, here, turn, step_mm = [], start, 0.0, 0.08
    while width_mm > 0.14:
        turn = 0.97 * turn + rng.normal(0, 0.005)
        heading += turn
        here = here + step_mm * np.array([np.cos(heading), np.sin(heading)])
        width_mm *= 0.9985
        rows.append(np.append(here, width_mm))
        if rng.random() < 0.008:
            side = rng.choice([-1, 1])
            rows += vessel_tree(rng, here, heading + side * rng.uniform(0.5, 1.1), 0.7 * width_mm)
            heading -= 0.2 * side
    return rows


def vessel_strength(colon: Colon, seed: int, s: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """How much of a vessel shows at each place of the wall, from 0 to 1."""
    rng = np.random.default_rng([seed, 2])
    area_mm2 = 2 * np.pi * colon.radius_mm * colon.length_mm
    rows = []
    for _ in range(int(area_mm2 / 130)):
        start = rng.uniform(0, [colon.length_mm, 2 * np.pi * colon.radius_mm])
        rows += vessel_tree(rng, start, rng.uniform(0, 2 * np.pi), rng.uniform(0.24, 0.48))
    along, around, width_mm = np.array(rows).T

    def on_cylinder(s, phi):
        return np.stack(
            np.broadcast_arrays(s, colon.radius_mm * np.cos(phi), colon.radius_mm * np.sin(phi)), axis=-1
        )

    tree = cKDTree(on_cylinder(along, around / colon.radius_mm))
    distance_mm, nearest = tree.query(on_cylinder(s, phi), k=4, distance_upper_bound=1.2)
    shape = np.exp(-((distance_mm / np.append(width_mm, 1)[nearest]) ** 2))
    depth = np.append(0.25 + 0.6 * np.clip(width_mm / 0.4, 0, 1), 0)[nearest]
    return (shape * depth).max(axis=-1)


def mucosa(colon: Colon, seed: int, s: np.ndarray, phi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Albedo [M, N, 3] (linear RGB) and roughness [M, N] (from .25 to .6) of the wall."""
    rng = np.random.default_rng([seed, 3])
    pale, red, vessel = np.array([[0.74, 0.44, 0.34], [0.66, 0.30, 0.24], [0.46, 0.13, 0.13]])
    mottle = 0.7 * smooth_field(rng, s, phi, 7.0, colon.radius_mm) + 0.3 * smooth_field(
        rng, s, phi, 1.6, colon.radius_mm
    )
    redness = 0.5 + 0.45 * np.tanh(mottle)
    for polyp_s, polyp_phi, size, _ in colon.polyps:
        on_polyp = np.exp(-((polyp_distance_mm(colon, s, phi, polyp_s, polyp_phi) / size) ** 4))
        redness += on_polyp * (0.9 + 0.1 * mottle - redness)
    albedo = pale + redness[..., None] * (red - pale)
    albedo += vessel_strength(colon, seed, s, phi)[..., None] * (vessel - albedo)
    roughness = 0.425 + 0.175 * np.tanh(smooth_field(rng, s, phi, 16.0, colon.radius_mm))
    return albedo, roughness


def fly_through(colon: Colon, frames: int, step_mm: float = 0.62, start_mm: float = 3.0) -> np.ndarray:
    """Poses T_world_camera [frames, 4, 4]: along the centreline, a little off it, looking about."""
    s = start_mm + step_mm * np.arange(frames)
    point, frame = centreline(colon, s)
    t = 2 * np.pi * (s - start_mm) / 15
    point = point + frame[..., 0] * (1.6 * np.sin(t))[:, None] + frame[..., 1] * (1.2 * np.cos(t))[:, None]
    poses = np.tile(np.eye(4), (frames, 1, 1))
    for pose, R, p, a in zip(poses, frame, point, t, strict=True):
        look = np.array([0.20 * np.sin(0.8 * a + 0.4), 0.12 + 0.24 * np.sin(a + 1.2), 0.15 * np.sin(0.7 * a)])
        pose[:3, :3], pose[:3, 3] = R @ cv2.Rodrigues(look)[0], p
    return poses


def tissue_mesh(vertices, triangles, normals, albedo, roughness, **more):
    """Mitsuba's mesh of the wall under the principled BSDF, with ``more`` of its parameters."""
    bsdf = {
        "type": "principled",
        "base_color": {"type": "mesh_attribute", "name": "vertex_albedo"},
        "roughness": {"type": "mesh_attribute", "name": "vertex_roughness"},
        "specular": 0.5,
        "metallic": 0.0,
        **more,
    }
    props = mi.Properties()
    props["mesh_bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh("colon", len(vertices), len(triangles), has_vertex_normals=True, props=props)
    mesh.add_attribute("vertex_albedo", 3, np.float32(albedo).ravel())
    mesh.add_attribute("vertex_roughness", 1, np.float32(roughness).ravel())
    buffers = mi.traverse(mesh)
    buffers["vertex_positions"] = np.float32(vertices).ravel()
    buffers["vertex_normals"] = np.float32(normals).ravel()
    buffers["faces"] = np.uint32(triangles).ravel()
    buffers.update()
    return mesh


class Renderer:
    """Mitsuba's scene of the mesh and one point light of unit intensity, which goes with the camera."""

    def __init__(self, camera: Camera, vertices, triangles, normals, albedo, roughness):
        self.camera = camera
        self.triangles, self.vertices = triangles, vertices
        self.materials = np.column_stack([albedo.reshape(-1, 3), roughness.ravel()])
        mesh = tissue_mesh(vertices, triangles, normals, albedo, roughness)
        self.scene = mi.load_dict(
            {"type": "scene", "colon": mesh, "light": {"type": "point", "intensity": 1.0}}
        )
        self.light = mi.traverse(self.scene)

    def _image(self, T_world_camera: np.ndarray, integrator: dict, samples: int) -> np.ndarray:
        """What an integrator sees, float32 [H, W, C], on a regular grid of samples in each pixel."""
        film = {"type": "hdrfilm", "width": self.camera.width, "height": self.camera.height}
        film |= {"rfilter": {"type": "box"}, "component_format": "float32", "pixel_format": "rgb"}
        sensor = {
            "type": "perspective",
            "fov": float(np.degrees(2 * np.arctan(0.5 / self.camera.focal_widths))),
            "near_clip": 0.01,
            "to_world": mi.ScalarTransform4f(T_world_camera @ np.diag([-1.0, -1.0, 1.0, 1.0])),
            "sampler": {"type": "stratified", "sample_count": samples, "jitter": False},
            "film": film,
        }
        integrator = mi.load_dict({"block_size": 16, **integrator})
        return np.array(mi.render(self.scene, sensor=mi.load_dict(sensor), integrator=integrator))

    def radiance(self, T_world_camera: np.ndarray) -> np.ndarray:
        """Radiance [H, W, 3] for unit intensity, anti-aliased by 25 samples a pixel.

        Lens and light coincide: the light's cos² is that of the viewing direction and multiplies the image.
        """
        self.light["light.position"] = mi.ScalarPoint3f(T_world_camera[:3, 3])
        self.light.update()
        image = self._image(T_world_camera, {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}, 25)
        return image[..., :3] * self.camera.cos2()[..., None]

    def maps(self, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """At pixel centres: z-depth in mm (0 for none), normals in the camera frame, albedo, roughness."""
        aovs = "hit:depth,point:position,normal:sh_normal,triangle:prim_index"
        image = self._image(T_world_camera, {"type": "aov", "aovs": aovs}, 1).astype(np.float64)
        hit, point, normal = image[..., 0] > 0, image[..., 1:4], image[..., 4:7]
        R, centre = T_world_camera[:3, :3], T_world_camera[:3, 3]
        depth_mm = np.where(hit, ((point - centre) @ R)[..., 2], 0)
        corners = self.triangles[image[..., 7].astype(np.int64)]
        weights = barycentric(self.vertices[corners], point)
        materials = np.where(hit[..., None], np.einsum("hwk,hwkc->hwc", weights, self.materials[corners]), 0)
        return depth_mm, np.where(hit[..., None], normal @ R, 0), materials[..., :3], materials[..., 3]


def barycentric(corners: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Barycentric coordinates [..., 3] of points [..., 3] in triangles [..., 3, 3], by ratios of areas."""
    a, b, c = np.moveaxis(corners, -2, 0)
    normal = np.cross(b - a, c - a)
    u = np.einsum("...i,...i", np.cross(c - b, point - b), normal)
    v = np.einsum("...i,...i", np.cross(a - c, point - c), normal)
    area = np.einsum("...i,...i", normal, normal)
    return np.clip(np.stack([u / area, v / area, 1 - (u + v) / area], axis=-1), 0, 1)


def photograph(
    radiance: np.ndarray, intensity: float, noise_levels: float, rng: np.random.Generator
) -> np.ndarray:
    """The camera's response: exposure, gamma 1/2.2, noise, 8 bits."""
    display = np.clip(intensity * radiance, 0, 1) ** GAMMA
    return np.clip(np.rint(255 * display + rng.normal(0, noise_levels, radiance.shape)), 0, 255).astype(
        np.uint8
    )


def to_u16(values: np.ndarray, full: float) -> np.ndarray:
    """Values from 0 to ``full`` as 16 bits."""
    return np.rint(np.clip(values / full, 0, 1) * 65535).astype(np.uint16)


def write(path: Path, image: np.ndarray) -> None:
    """Write grey or RGB as PNG or deflated TIFF, with the options that make noisy images smallest."""
    options = {
        ".tiff": (
            *(cv2.IMWRITE_TIFF_COMPRESSION, TIFF_DEFLATE, cv2.IMWRITE_TIFF_PREDICTOR, TIFF_HORIZONTAL),
            *(cv2.IMWRITE_TIFF_ROWSPERSTRIP, image.shape[0]),
        ),
        ".png": (cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE),
    }
    image = image[..., ::-1] if image.ndim == 3 else image
    if not cv2.imwrite(str(path), image, options[path.suffix]):
        raise OSError(f"cannot write {path}")


def write_ply(path: Path, vertices: np.ndarray, triangles: np.ndarray) -> None:
    """A binary PLY of vertices [V, 3] and triangles [F, 3]."""
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    header += f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    faces = np.empty(len(triangles), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, triangles
    path.write_bytes(header.encode() + vertices.astype("<f4").tobytes() + faces.tobytes())


def make(folder: Path, colon: Colon, camera: Camera, frames: int, seed: int) -> None:
    """Build the scene, render all frames, and write the sequence and its truth."""
    truth = folder / "truth"
    truth.mkdir(parents=True)
    s, phi = wall_grid(colon, seed)
    vertices, triangles, normals = wall_mesh(colon, seed, s, phi)
    renderer = Renderer(camera, vertices, triangles, normals, *mucosa(colon, seed, s, phi))
    poses = fly_through(colon, frames)
    radiances = []
    for index, pose in enumerate(poses):
        radiances.append(renderer.radiance(pose))
        depth_mm, normal, albedo, roughness = renderer.maps(pose)
        write(folder / f"{index:04d}_depth.tiff", to_u16(depth_mm, DEPTH_RANGE_MM))
        if index == 0:
            write(folder / f"{index:04d}_normals.tiff", to_u16(normal + 1, 2.0))
        if index % TRUTH_EVERY == 0:
            write(truth / f"{index:04d}_albedo.png", np.rint(255 * albedo).astype(np.uint8))
            write(truth / f"{index:04d}_roughness.png", np.rint(255 * roughness).astype(np.uint8))
        print(f"rendered frame {index + 1} of {frames}", flush=True)
    intensity = float(1 / np.quantile(np.stack(radiances), 0.998))
    rng = np.random.default_rng([seed, 4])
    for index, radiance in enumerate(radiances):
        write(folder / f"{index:04d}_color.png", photograph(radiance, intensity, camera.noise_levels, rng))
    rows = poses.transpose(0, 2, 1).reshape(-1, 16)
    (folder / "pose.txt").write_text("".join(",".join(f"{x:.9g}" for x in row) + "\n" for row in rows))
    (folder / "camera.json").write_text(json.dumps(camera.to_json(), indent=1) + "\n")
    light = {"position": [0, 0, 0], "intensity": intensity, "n": 2, "q": 2}
    made = {"seed": seed, "light": light, "gamma": GAMMA, "noise_levels": camera.noise_levels}
    made |= {"bsdf": {"type": "principled", "specular": 0.5, "metallic": 0.0}, "colon": asdict(colon)}
    (truth / "made.json").write_text(json.dumps(made, indent=1) + "\n")
    # Some grid lines only, more along the folds' profile: the mesh that was rendered is far larger.
    coarse = vertices.reshape(len(s), phi.size, 3)[::3, ::6]
    write_ply(truth / "colon.ply", coarse.reshape(-1, 3), grid_triangles(*coarse.shape[:2]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder to make; must not exist")
    parser.add_argument("--frames", type=int, default=24, help="at most 60, 0.62 mm apart")
    parser.add_argument("--width", type=int, default=Camera.width)
    parser.add_argument("--height", type=int, default=Camera.height)
    parser.add_argument("--seed", type=int, default=7, help="of folds, vessels, materials and noise")
    parser.add_argument(
        "--edge-mm", type=float, default=Colon.edge_mm, help="edge length of the rendered mesh"
    )
    args = parser.parse_args()
    if args.output.exists():
        parser.error(f"{args.output} exists already: name another folder, or remove it")
    if not 1 <= args.frames <= 60:
        parser.error("--frames must lie between 1 and 60: the tube ends there")
    make(args.output, Colon(edge_mm=args.edge_mm), Camera(args.width, args.height), args.frames, args.seed)


if __name__ == "__main__":
    main()

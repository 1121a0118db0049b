"""Exports are read back by other people's libraries, and show there what the twin shows."""

import json
import os
import re
import shutil
import struct
import subprocess
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
import tube_twin
from faults import killed_at_every_operation
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from endotwin.cameras import Pinhole
from endotwin.effects import Effects
from endotwin.effects.coat import Coat
from endotwin.effects.film import Film
from endotwin.effects.interreflection import Interreflection
from endotwin.effects.offset import Offset
from endotwin.effects.profile import Profile
from endotwin.errors import OptionError, OutputError, TwinError
from endotwin.evaluation.metrics import psnr
from endotwin.export import FORMATS, export
from endotwin.export.appearance import Appearance, diffuse_color
from endotwin.export.glb import srgb
from endotwin.export.mitsuba import matrix
from endotwin.export.textured import textured
from endotwin.light import film as light_film
from endotwin.light import shading
from endotwin.surface.vectors import unit

TURN = np.diag([1.0, -1.0, -1.0])
GUIDES = ((3.24, 0.55, 0.0), (-2.77, 2.66, 0.0), (-1.27, -3.14, 0.0))
VALIDATE = """
require("gltf-validator").validateBytes(new Uint8Array(require("fs").readFileSync(process.argv[1])))
.then(report => console.log(JSON.stringify(report)))"""


@pytest.fixture(scope="module")
def twin():
    return tube_twin.fitted(tube_twin.seen(tube_twin.surface(fold_mm=2.0)))


@pytest.fixture(scope="module")
def files(twin, tmp_path_factory) -> Path:
    """A folder with ``colon`` in the formats of a lighter mesh."""
    folder = tmp_path_factory.mktemp("exported")
    for suffix in (".glb", ".obj"):
        export(with_effects(twin, Offset(GUIDES), Coat(0.5, 0.1)), folder / f"colon{suffix}")
    return folder


@pytest.fixture(scope="module")
def document(files) -> dict:
    """The JSON of the GLB."""
    content = (files / "colon.glb").read_bytes()
    assert struct.unpack_from("<4sII", content) == (b"glTF", 2, len(content))
    length, kind = struct.unpack_from("<I4s", content, 12)
    assert kind == b"JSON"
    return json.loads(content[20 : 20 + length])


def with_film(twin):
    """Wet where the tube's wall is seen from ``pose(0.5)``, with a normal that mirrors a lamp at the lens."""
    surface, pose = twin.surface, tube_twin.pose(0.5)
    towards = surface.to_local(pose)[:3, 3] - surface.vertices_mm
    distance_mm = np.linalg.norm(towards, axis=1)
    vertex = np.flatnonzero((distance_mm > 8) & (np.arange(len(towards)) % 3 > 0)).astype(np.int32)
    normal = np.float32(towards / distance_mm[:, None])[vertex]
    weight = np.linspace(0.2, 1.5, len(vertex), dtype=np.float32)
    wet = replace(twin.materials, film=light_film.Film(vertex, normal, weight))
    return with_effects(replace(twin, materials=wet), Film(1.0, 0.2))


def with_effects(twin, *effects):
    return replace(twin, effects=Effects(effects))


def test_a_ply_has_every_map_of_every_vertex_by_name(twin, tmp_path):
    export(with_effects(twin, Offset(GUIDES), Coat(0.5, 0.1)), tmp_path / "colon.ply")
    mesh = trimesh.load(tmp_path / "colon.ply", process=False)
    np.testing.assert_allclose(mesh.vertices, twin.surface.vertices_mm + twin.surface.origin_mm, atol=1e-4)
    np.testing.assert_array_equal(mesh.faces, twin.surface.triangles)
    np.testing.assert_allclose(mesh.vertex_normals, twin.surface.normals, atol=1e-6)
    rows = mesh.metadata["_ply_raw"]["vertex"]["data"]
    for index, letter in enumerate("rgb"):
        np.testing.assert_array_equal(rows[f"base_color_{letter}"], twin.materials.base_color[:, index])
    np.testing.assert_array_equal(rows["roughness"], twin.materials.roughness)
    np.testing.assert_array_equal(rows["seen_by"], twin.surface.seen_by)
    np.testing.assert_array_equal(rows["nearest_mm"], twin.surface.nearest_mm)


def test_a_ply_has_the_film_of_every_vertex(twin, tmp_path):
    wet = with_film(twin)
    export(wet, tmp_path / "wet.ply")
    film = wet.materials.film
    rows = trimesh.load(tmp_path / "wet.ply", process=False).metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(np.flatnonzero(rows["film_weight"]), film.vertex)
    np.testing.assert_array_equal(rows["film_weight"][film.vertex], film.weight)
    for index, letter in enumerate("xyz"):
        np.testing.assert_array_equal(rows[f"film_normal_{letter}"][film.vertex], film.normal[:, index])


@pytest.mark.slow
def test_a_film_is_a_clear_coat_with_normals_of_its_own(twin, tmp_path):
    """Of each texel that a ray meets, weight and normal are those of the film beneath it."""
    wet = with_film(twin)
    everywhere = light_film.Film(
        np.arange(len(twin.surface.vertices_mm), dtype=np.int32),
        np.float32(twin.surface.normals[:, [1, 2, 0]] * 0.3 + twin.surface.normals),
        np.linspace(0.5, 1.5, len(twin.surface.vertices_mm), dtype=np.float32),
    )
    everywhere = replace(everywhere, normal=np.float32(unit(everywhere.normal)))
    wet = replace(wet, materials=replace(wet.materials, film=everywhere))
    export(wet, tmp_path / "wet.glb")
    content = (tmp_path / "wet.glb").read_bytes()
    length = struct.unpack_from("<I", content, 12)[0]
    document, binary = json.loads(content[20 : 20 + length]), content[28 + length :]
    coat = document["materials"][0]["extensions"]["KHR_materials_clearcoat"]

    def picture(name: str) -> np.ndarray:
        image = document["images"][document["textures"][coat[name]["index"]]["source"]]
        view = document["bufferViews"][image["bufferView"]]
        stored = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        return cv2.imdecode(np.frombuffer(stored, np.uint8), cv2.IMREAD_UNCHANGED)[..., ::-1]

    def attribute(name: str) -> np.ndarray:
        accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"][name]]
        start = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
        width = {"VEC2": 2, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        return np.frombuffer(binary, "<f4", accessor["count"] * width, start).reshape(-1, width)

    normals = picture("clearcoatNormalTexture")
    assert normals.dtype == np.uint16
    height, width, _ = normals.shape
    u, v = np.clip(attribute("TEXCOORD_0") * [width, height], 0, [width - 1, height - 1]).astype(int).T
    x, y, z = np.moveaxis(normals[v, u] / 32767.5 - 1, -1, 0)[..., None]
    facing, tangent = attribute("NORMAL"), attribute("TANGENT")
    across = np.cross(facing, tangent[:, :3]) * tangent[:, 3:]
    places = attribute("POSITION") @ TURN * 1000
    nearest = cKDTree(twin.surface.vertices_mm).query(places)[1]
    shown = (x * tangent[:, :3] + y * across + z * facing) @ TURN
    agreement = (shown * everywhere.normal[nearest]).sum(axis=1)
    assert np.quantile(agreement, 0.05) > 0.98
    strength = picture("clearcoatTexture")[v, u, 0] / 255 * coat["clearcoatFactor"] * 0.04
    expected = everywhere.weight[nearest] * shading.F0_WATER
    assert np.quantile(np.abs(strength - expected), 0.95) < 0.1 * expected.max()
    assert np.median(picture("clearcoatRoughnessTexture")[v, u, 1]) == round(255 * 0.2)


@pytest.mark.slow
@pytest.mark.skipif(find_spec("pxr") is None, reason="USD is not installed (pip install 'endotwin[usd]')")
def test_usd_finds_mesh_textures_camera_path_and_light_in_a_package_and_nothing_wrong_with_it(twin, tmp_path):
    from pxr import Usd, UsdGeom, UsdLux, UsdShade, UsdValidation

    from endotwin.synth.trajectories.recorded import path_or_flight

    export(with_effects(twin, Offset(GUIDES), Coat(0.5, 0.1)), tmp_path / "colon.usdz")
    stage = Usd.Stage.Open(str(tmp_path / "colon.usdz"))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    wrong = UsdValidation.ValidationContext(validators).Validate(stage)
    assert len(validators) >= 20 and [each.GetMessage() for each in wrong] == []
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 1.0)
    world = (twin.surface.vertices_mm + twin.surface.origin_mm) @ TURN / 1000
    prim = stage.GetPrimAtPath("/endotwin/tissue")
    bounds = UsdGeom.Imageable(prim).ComputeWorldBound(0, "default").ComputeAlignedRange()
    np.testing.assert_allclose([bounds.min, bounds.max], [world.min(axis=0), world.max(axis=0)], atol=2e-4)
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    surface = material.ComputeSurfaceSource()[0]
    assert surface.GetInput("clearcoat").Get() * 0.04 == pytest.approx(0.5 * shading.F0_WATER)
    assert ((surface.GetInput("ior").Get() - 1) / (surface.GetInput("ior").Get() + 1)) ** 2 == pytest.approx(
        twin.materials.f0, rel=1e-5
    )
    for name in ("diffuseColor", "roughness", "normal"):
        texture = UsdShade.Shader(surface.GetInput(name).GetConnectedSources()[0][0].source)
        assert texture.GetInput("file").Get().resolvedPath.endswith(".png]")
    poses, camera = path_or_flight(twin), UsdGeom.Camera.Get(stage, "/endotwin/camera")
    assert stage.GetEndTimeCode() == len(poses) - 1
    for time in (0, len(poses) - 1):
        placed = np.array(UsdGeom.XformCache(time).GetLocalToWorldTransform(camera.GetPrim())).T
        np.testing.assert_allclose(placed[:3, 3], TURN @ poses[time][:3, 3] / 1000, atol=1e-7)
        np.testing.assert_allclose(placed[:3, :3], TURN @ poses[time][:3, :3] @ TURN, atol=1e-6)
    lens = camera.GetCamera(0)
    assert lens.focalLength / lens.horizontalAperture == pytest.approx(
        tube_twin.CAMERA.fx / tube_twin.CAMERA.width, rel=0.02
    )
    lamp = UsdLux.SphereLight.Get(stage, "/endotwin/camera/guide_1")
    power = lamp.GetIntensityAttr().Get() * np.pi * lamp.GetRadiusAttr().Get() ** 2
    np.testing.assert_allclose(3 * power / np.pi, 2 * twin.light.L0 * 1e-6, rtol=1e-5)


def test_without_usd_a_package_is_refused_in_a_sentence(twin, tmp_path, monkeypatch):
    monkeypatch.setattr("endotwin.export.usdz.Usd", None)
    with pytest.raises(OptionError, match=r"endotwin\[usd\]"):
        export(twin, tmp_path / "colon.usdz")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_glb_is_the_surface_in_metres_with_y_up(twin, files):
    scene = trimesh.load(files / "colon.glb")
    mesh = scene.to_geometry()
    world = (twin.surface.vertices_mm + twin.surface.origin_mm) @ TURN / 1000
    np.testing.assert_allclose(mesh.bounds, [world.min(axis=0), world.max(axis=0)], atol=2e-4)
    from endotwin.fusion._open3d import o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(np.float32(mesh.vertices), np.uint32(mesh.faces))
    distance_m = scene.compute_distance(np.float32(world)).numpy()
    assert np.quantile(distance_m, 0.99) < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_textures_show_the_albedo_that_the_twin_has_there(twin, files, suffix):
    mesh = trimesh.load(files / f"colon{suffix}", force="mesh")
    turn, mm = (TURN, 1000) if suffix == ".glb" else (np.eye(3), 1)
    pose, rays = tube_twin.pose(0.5), twin.camera.pixel_directions[::2, ::2].reshape(-1, 3)
    origins = np.broadcast_to(pose[:3, 3] @ turn / mm, rays.shape)
    where, ray, triangle = mesh.ray.intersects_location(
        origins, rays @ pose[:3, :3].T @ turn, multiple_hits=False
    )
    corners = trimesh.triangles.points_to_barycentric(mesh.triangles[triangle], where)
    uv = np.einsum("nk,nka->na", corners, mesh.visual.uv[mesh.faces[triangle]])
    material = mesh.visual.material
    picture = np.asarray(material.baseColorTexture if suffix == ".glb" else material.image)[..., :3] / 255
    height, width, _ = picture.shape
    column = np.clip((uv[:, 0] * width).astype(int), 0, width - 1)
    row = np.clip(((1 - uv[:, 1]) * height).astype(int), 0, height - 1)
    shown = picture[row, column]
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    view = twin.render(pose)
    expected = view.image(view.attribute(diffuse_color(twin)))[::2, ::2].reshape(-1, 3)[ray]
    assert len(ray) > 0.995 * view.mask[::2, ::2].sum()
    assert psnr(linear, expected, np.ones(len(ray), bool)) > 36


@pytest.mark.slow
def test_the_normal_map_turns_the_light_mesh_into_the_twins_normals(twin):
    from endotwin.export.textured import textured

    mesh = textured(twin)
    rows = np.flatnonzero((mesh.uv > 0.01).all(axis=1) & (mesh.uv < 0.99).all(axis=1))
    height, width, _ = mesh.normal.shape
    u, v = (mesh.uv[rows] * [width, height]).astype(int).T
    along, sign = mesh.tangents[rows, :3], mesh.tangents[rows, 3:]
    np.testing.assert_allclose((along * mesh.normals[rows]).sum(axis=1), 0, atol=1e-5)
    x, y, z = mesh.normal[v, u].T[..., None]
    mapped = x * along + y * sign * np.cross(mesh.normals[rows], along) + z * mesh.normals[rows]
    nearest = trimesh.proximity.ProximityQuery(twin.to_trimesh()).vertex(
        mesh.vertices_mm[rows] + twin.surface.origin_mm
    )[1]
    agreement = (mapped * twin.surface.normals[nearest]).sum(axis=1)
    assert np.quantile(agreement, 0.05) > 0.98


@pytest.mark.slow
def test_a_glb_carries_the_exact_light_and_its_spots_hang_on_the_camera(twin, document, files):
    exact = document["extras"]["endotwin"]
    assert document["extras"]["mm_per_unit"] == 1000
    assert [exact[name] for name in ("L0", "n", "q", "gamma", "f0")] == [
        twin.light.L0, twin.light.n, twin.light.q, twin.response.gamma, twin.materials.f0,
    ]  # fmt: skip
    np.testing.assert_allclose(exact["guides_mm"], GUIDES)
    camera = next(node for node in document["nodes"] if "camera" in node)
    spots = [document["nodes"][child] for child in camera["children"]]
    np.testing.assert_allclose([spot["translation"] for spot in spots], GUIDES @ TURN / 1000)
    (lamp,) = document["extensions"]["KHR_lights_punctual"]["lights"]
    # q = 2, n = 2: on the axis, 1 m away, a white Lambertian patch of radiance 2·L0·1e-6 a guide
    np.testing.assert_allclose(3 * lamp["intensity"] / np.pi, 2 * twin.light.L0 * 1e-6)
    assert lamp["spot"]["innerConeAngle"] == 0
    np.testing.assert_allclose(lamp["spot"]["outerConeAngle"], np.pi / 2, atol=1e-12)
    (material,) = document["materials"]
    coat = material["extensions"]["KHR_materials_clearcoat"]
    assert coat["clearcoatFactor"] * 0.04 == pytest.approx(0.5 * shading.F0_WATER)
    (library,) = files.glob("colon-*.mtl")
    written = dict(line.split(" ", 1) for line in library.read_text().splitlines()[1:])
    assert float(written["Pc"]) == pytest.approx(coat["clearcoatFactor"], rel=1e-4)
    specular = material["extensions"]["KHR_materials_specular"]
    assert specular["specularColorFactor"][0] * 0.04 == pytest.approx(twin.materials.f0)


@pytest.mark.slow
def test_the_camera_of_a_glb_stands_where_the_path_begins_and_looks_along_it(twin, document):
    from endotwin.synth.trajectories.recorded import path_or_flight

    pose = path_or_flight(twin)[0]
    camera = next(node for node in document["nodes"] if "camera" in node)
    turned = Rotation.from_quat(camera["rotation"]).as_matrix()
    np.testing.assert_allclose(camera["translation"], TURN @ pose[:3, 3] / 1000, atol=1e-7)
    np.testing.assert_allclose(turned @ [0, 0, -1], TURN @ pose[:3, 2], atol=1e-6)
    np.testing.assert_allclose(turned @ [0, 1, 0], TURN @ -pose[:3, 1], atol=1e-6)
    (lens,) = document["cameras"]
    half = np.arctan(tube_twin.CAMERA.height / 2 / tube_twin.CAMERA.fy)
    assert lens["perspective"]["yfov"] == pytest.approx(2 * half, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("film", [False, True])
def test_khronos_validator_finds_nothing_wrong_with_a_glb(twin, files, tmp_path, film):
    node = shutil.which("node")
    if not node or subprocess.run([node, "-e", "require('gltf-validator')"], capture_output=True).returncode:
        pytest.skip("node finds no gltf-validator (npm install gltf-validator, NODE_PATH)")
    file = (tmp_path if film else files) / "colon.glb"
    if film:
        export(with_film(twin), file)
    done = subprocess.run([node, "-e", VALIDATE, file], capture_output=True, check=True)
    issues = json.loads(done.stdout)["issues"]
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]


@pytest.mark.slow
@pytest.mark.skipif("ENDOTWIN_BPY" not in os.environ, reason="ENDOTWIN_BPY names no Python that has bpy")
def test_blender_opens_a_glb_with_its_textures_lights_and_camera(files):
    script = """
import bpy, json, sys
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=sys.argv[1])
trees = [material.node_tree for material in bpy.data.materials]
images = [node.image for tree in trees for node in tree.nodes if node.type == "TEX_IMAGE"]
lamps = [each for each in bpy.data.objects if each.type == "LIGHT"]
found = {"images": sorted(image.name for image in images if min(image.size) > 16),
         "parents": [lamp.parent.type for lamp in lamps]}
print("FOUND", json.dumps(found))"""
    done = subprocess.run(
        [os.environ["ENDOTWIN_BPY"], "-c", script, files / "colon.glb"],
        capture_output=True,
        text=True,
        check=True,
    )
    found = json.loads(next(line for line in done.stdout.splitlines() if line.startswith("FOUND"))[6:])
    assert found == {"images": ["base colour", "normal", "roughness"], "parents": ["CAMERA"] * 3}


@pytest.mark.slow
@pytest.mark.skipif(find_spec("mitsuba") is None, reason="Mitsuba is not installed (pip install mitsuba)")
@pytest.mark.parametrize(
    ("effects", "diffuse"),
    [
        ((), "burley"),
        ((), "lambert"),
        ((Offset(GUIDES),), "burley"),
        ((Profile(1.0),), "burley"),
        ((Coat(2.0, 0.15),), "burley"),
        ((Coat(2.0, 0.15), Offset(GUIDES)), "lambert"),
        ((Interreflection(),), "burley"),
    ],
    ids=["plain", "lambert", "guides", "profile", "coat", "all", "bounced"],
)
def test_mitsuba_renders_what_the_twin_renders(twin, tmp_path, effects, diffuse):
    import mitsuba

    mitsuba.set_variant("scalar_rgb")
    twin = replace(with_effects(twin, *effects), materials=replace(twin.materials, diffuse=diffuse))
    twin = replace(twin, camera=Pinhole(64, 48, 40.0, 40.0, 26.0, 21.5))
    export(twin, tmp_path / "scene.mitsuba")
    pose = tube_twin.pose(0.5)
    scene = mitsuba.load_file(str(tmp_path / "scene.mitsuba" / "scene.xml"), pose=matrix(pose), spp=36)
    radiance = np.array(mitsuba.render(scene))[..., :3]
    color = np.clip(radiance, 0, 1) ** twin.response.gamma
    view = twin.render(pose)
    bounced = "interreflection" in twin.effects  # endotwin also guesses what tissue beyond the ends adds
    ratio = np.median(radiance[view.mask] / view.radiance[view.mask])
    assert ratio == pytest.approx(1, abs=0.07 if bounced else 0.02)
    assert psnr(color, view.color, view.mask) > (30 if bounced else 35)


@pytest.mark.slow
@pytest.mark.skipif(find_spec("mitsuba") is None, reason="Mitsuba is not installed (pip install mitsuba)")
def test_mitsuba_mirrors_the_light_in_the_film_where_the_twin_does(twin, tmp_path):
    import mitsuba

    mitsuba.set_variant("scalar_rgb")
    wet = replace(with_film(twin), camera=Pinhole(64, 48, 40.0, 40.0, 26.0, 21.5))
    wet.export(tmp_path / "scene.mitsuba")
    pose = tube_twin.pose(0.5)
    scene = mitsuba.load_file(str(tmp_path / "scene.mitsuba" / "scene.xml"), pose=matrix(pose), spp=36)
    color = np.clip(np.array(mitsuba.render(scene))[..., :3], 0, 1) ** wet.response.gamma
    view, dry = wet.render(pose), replace(wet, effects=Effects(())).render(pose)
    assert psnr(color, view.color, view.mask) > max(30, psnr(color, dry.color, view.mask) + 6)


def test_what_cannot_be_exported_is_refused_in_a_sentence_and_leaves_nothing(twin, tmp_path):
    with pytest.raises(OptionError, match=", ".join(FORMATS).replace(".", r"\.")):
        twin.export(tmp_path / "colon.fbx")
    with pytest.raises(TwinError, match="no materials"):
        tube_twin.unfitted(twin).export(tmp_path / "colon.ply")
    (tmp_path / "colon.ply").write_text("precious")
    with pytest.raises(OutputError, match="overwrite=True"):
        twin.export(tmp_path / "colon.ply")
    (tmp_path / "mine.mitsuba").mkdir()
    (tmp_path / "mine.mitsuba" / "notes.txt").write_text("precious")
    with pytest.raises(OutputError, match="not endotwin's to replace"):
        twin.export(tmp_path / "mine.mitsuba", overwrite=True)
    assert sorted(os.listdir(tmp_path)) == ["colon.ply", "mine.mitsuba"]
    assert (tmp_path / "colon.ply").read_text() == "precious"


def files_of_obj(file: Path) -> dict[str, bytes]:
    """An OBJ, the material that it names, and the pictures that the material names."""
    found = {file.name: file.read_bytes()}
    for name in re.findall(r"^mtllib (.+)$", found[file.name].decode(), re.MULTILINE):
        found[name] = file.with_name(name).read_bytes()
        for picture in re.findall(r"^(?:map_\w+|norm) (.+)$", found[name].decode(), re.MULTILINE):
            found[picture] = file.with_name(picture).read_bytes()
    return found


@pytest.mark.slow
def test_an_obj_and_all_it_refers_to_are_old_or_new_wherever_its_export_is_killed(
    twin, tmp_path, monkeypatch
):
    file, seen, mesh = tmp_path / "my twin.obj", [], textured(twin)
    corners, few = np.unique(mesh.triangles[:100], return_inverse=True)
    parts = {part: getattr(mesh, part)[corners] for part in ("vertices_mm", "normals", "uv")}
    parts |= {part: getattr(mesh, part)[::8, ::8] for part in ("base_color", "roughness", "normal")}
    looks = {"old": replace(mesh, triangles=few.reshape(-1, 3), **parts)}
    looks["new"] = replace(looks["old"], base_color=looks["old"].base_color / 2)

    look = Appearance.of(twin)
    monkeypatch.setattr(Appearance, "of", lambda _: look)

    def write(which: str) -> None:
        monkeypatch.setattr("endotwin.export.obj.textured", lambda _: looks[which])
        export(twin, file, overwrite=True)

    whole = {}
    for which in ("new", "old"):
        write(which)
        whole[which] = files_of_obj(file)
        assert len(whole[which]) == 5 and {each.name for each in tmp_path.iterdir()} == set(whole[which])

    def check() -> None:
        seen.append(next(which for which in whole if files_of_obj(file) == whole[which]))
        write("old")
        assert {each.name: each.read_bytes() for each in tmp_path.iterdir()} == whole["old"]

    assert killed_at_every_operation(lambda: write("new"), check) >= 20
    assert seen == sorted(seen, reverse=True) and set(seen) == {"old", "new"}
    np.testing.assert_array_equal(
        np.asarray(trimesh.load(file).visual.material.image), np.rint(255 * srgb(looks["old"].base_color))
    )


@pytest.mark.slow
def test_a_mitsuba_scene_is_replaced_with_its_guests_kept(twin, tmp_path):
    folder = tmp_path / "colon.mitsuba"
    export(twin, folder)
    names = sorted(os.listdir(folder))
    (folder / "notes.txt").write_text("mine")
    export(with_effects(twin, Coat(0.5, 0.1)), folder, overwrite=True)
    assert sorted(os.listdir(folder)) == sorted([*names, "notes.txt"])
    assert os.listdir(tmp_path) == ["colon.mitsuba"]

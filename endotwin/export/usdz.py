"""USD in one package: textured mesh, camera path, light guides that hang on the camera.

Axes, units and textures are those of the GLB. ``UsdPreviewSurface`` has one coat of one normal: a film is not
in it.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from endotwin.cameras.perspective import as_pinhole
from endotwin.errors import OptionError
from endotwin.export.appearance import Appearance
from endotwin.export.glb import FAR_M, M_PER_MM, NEAR_M, PATH_FPS, TURN, path_in_m, png, srgb
from endotwin.export.textured import Textured, textured
from endotwin.light.shading import ROUGHNESS_MIN
from endotwin.run.output import whole_file
from endotwin.synth.trajectories.recorded import path_or_flight
from endotwin.twin import Twin

try:
    from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade, UsdUtils, Vt
except ImportError:
    Usd = None

APERTURE = 36.0
"""Width of the camera's picture on its film: only its ratio to the focal length counts."""

LAMP_M = 1e-4
"""Radius of the sphere that shines as a light guide."""


def write_usdz(twin: Twin, path: Path, overwrite: bool = False) -> None:
    """Write ``twin`` as one package. Raises OptionError where USD is not installed."""
    if Usd is None:
        raise OptionError("a .usdz needs Pixar's library; install it with: pip install 'endotwin[usd]'")
    mesh, look = textured(twin), Appearance.of(twin)
    with whole_file(path, overwrite) as file:
        rough = np.maximum(mesh.roughness, ROUGHNESS_MIN)
        pictures = {"base_color": srgb(mesh.base_color), "roughness": rough, "normal": mesh.normal / 2 + 0.5}
        for name, picture in pictures.items():
            (file.parent / f"{name}.png").write_bytes(png(picture))
        layer = file.parent / "twin.usdc"
        stage = Usd.Stage.CreateNew(str(layer))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/endotwin").GetPrim())
        stage.GetRootLayer().customLayerData = {"endotwin": _plain(look.to_dict())}
        tissue = _mesh(stage, mesh, twin.surface.origin_mm)
        tissue.GetPrim().ApplyAPI(UsdShade.MaterialBindingAPI)
        UsdShade.MaterialBindingAPI(tissue).Bind(_material(stage, look))
        _camera(stage, twin)
        for number, guide_mm in enumerate(look.guides_mm):
            _guide(stage, f"/endotwin/camera/guide_{number}", look, np.asarray(guide_mm))
        stage.Save()
        UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(layer)), str(file))


def _plain(values: dict) -> dict:
    """What USD can keep as metadata: places of guides as one text."""
    return {
        name: value if isinstance(value, float | bool | str) else str(value) for name, value in values.items()
    }


def _mesh(stage: Usd.Stage, mesh: Textured, origin_mm: np.ndarray) -> UsdGeom.Mesh:
    turn = TURN.astype(np.float32)
    tissue = UsdGeom.Mesh.Define(stage, "/endotwin/tissue")
    points = (mesh.vertices_mm @ turn * M_PER_MM).astype(np.float32)
    tissue.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    tissue.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
    tissue.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.triangles), 3, np.int32)))
    tissue.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(mesh.triangles.astype(np.int32).ravel()))
    tissue.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy((mesh.normals @ turn).astype(np.float32)))
    tissue.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    tissue.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    tissue.CreateDoubleSidedAttr(True)
    st = UsdGeom.PrimvarsAPI(tissue).CreatePrimvar(
        "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex
    )
    upwards = np.c_[mesh.uv[:, 0], 1 - mesh.uv[:, 1]].astype(np.float32)
    st.Set(Vt.Vec2fArray.FromNumpy(upwards))
    tissue.AddTranslateOp().Set(_metres(origin_mm))
    return tissue


def _material(stage: Usd.Stage, look: Appearance) -> UsdShade.Material:
    """A ``UsdPreviewSurface``, whose metallic is 0 as that of the GLB."""
    material = UsdShade.Material.Define(stage, "/endotwin/material")
    uv = UsdShade.Shader.Define(stage, "/endotwin/material/uv")
    uv.CreateIdAttr("UsdPrimvarReader_float2")
    uv.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    surface = UsdShade.Shader.Define(stage, "/endotwin/material/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    root = math.sqrt(look.f0)
    values = {"metallic": 0.0, "ior": (1 + root) / (1 - root)}
    values |= {"clearcoat": look.coat_weight, "clearcoatRoughness": look.coat_roughness}
    for name, value in values.items():
        surface.CreateInput(name, Sdf.ValueTypeNames.Float).Set(value)
    kinds = Sdf.ValueTypeNames
    for name, picture, channels, kind in (
        ("diffuseColor", "base_color", "rgb", kinds.Color3f),
        ("roughness", "roughness", "r", kinds.Float),
        ("normal", "normal", "rgb", kinds.Normal3f),
    ):
        texture = UsdShade.Shader.Define(stage, f"/endotwin/material/{picture}")
        texture.CreateIdAttr("UsdUVTexture")
        texture.CreateInput("file", kinds.Asset).Set(f"./{picture}.png")
        texture.CreateInput("sourceColorSpace", kinds.Token).Set("sRGB" if picture == "base_color" else "raw")
        texture.CreateInput("st", kinds.Float2).ConnectToSource(uv.CreateOutput("result", kinds.Float2))
        for edge in ("wrapS", "wrapT"):
            texture.CreateInput(edge, kinds.Token).Set("clamp")
        if picture == "normal":
            texture.CreateInput("scale", kinds.Float4).Set(Gf.Vec4f(2, 2, 2, 1))
            texture.CreateInput("bias", kinds.Float4).Set(Gf.Vec4f(-1, -1, -1, 0))
        source = texture.CreateOutput(channels, kinds.Float if channels == "r" else kinds.Float3)
        surface.CreateInput(name, kind).ConnectToSource(source)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", kinds.Token))
    return material


def _camera(stage: Usd.Stage, twin: Twin) -> None:
    lens, poses = as_pinhole(twin.camera), path_or_flight(twin)
    camera = UsdGeom.Camera.Define(stage, "/endotwin/camera")
    camera.CreateHorizontalApertureAttr(APERTURE)
    camera.CreateVerticalApertureAttr(APERTURE * lens.height / lens.fy * lens.fx / lens.width)
    camera.CreateFocalLengthAttr(APERTURE * lens.fx / lens.width)
    camera.CreateHorizontalApertureOffsetAttr(APERTURE * (0.5 - (lens.cx + 0.5) / lens.width))
    camera.CreateClippingRangeAttr(Gf.Vec2f(NEAR_M, FAR_M))
    if not len(poses):
        return
    places, turns = path_in_m(poses)
    stage.SetTimeCodesPerSecond(PATH_FPS)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(len(poses) - 1)
    move, turn = camera.AddTranslateOp(), camera.AddOrientOp()
    for time, (place, (x, y, z, w)) in enumerate(zip(places.tolist(), turns.tolist(), strict=True)):
        move.Set(Gf.Vec3d(*place), time)
        turn.Set(Gf.Quatf(w, x, y, z), time)


def _guide(stage: Usd.Stage, name: str, look: Appearance, guide_mm: np.ndarray) -> None:
    """A sphere so bright that its intensity is I: radiance·π·r²; its cone has the edge of the GLB's spots."""
    light = UsdLux.SphereLight.Define(stage, name)
    light.AddTranslateOp().Set(_metres(guide_mm))
    light.CreateRadiusAttr(LAMP_M)
    intensity = look.intensity_mm2 * M_PER_MM**2 / len(look.guides_mm)
    light.CreateIntensityAttr(intensity / (math.pi * LAMP_M**2))
    shaping = UsdLux.ShapingAPI.Apply(light.GetPrim())
    shaping.CreateShapingConeAngleAttr(90.0)
    shaping.CreateShapingFocusAttr(look.n)


def _metres(place_mm: np.ndarray) -> Gf.Vec3d:
    return Gf.Vec3d(*(TURN @ place_mm * M_PER_MM + 0.0).tolist())

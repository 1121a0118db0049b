"""How each label becomes the bytes of a file, and an image again, and the words that say so."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO

import numpy as np
import tifffile
import torch

from endotwin.sequence.readers.c3vd import DEPTH_RANGE_MM
from endotwin.synth.containers import channels, deflated_tiff, exr, npz, pixels, png, tiff

FLOW_RANGE_PX = 20.0
UINT16 = 65535
FLOW_STEP_PX = 2 * FLOW_RANGE_PX / UINT16
HALF_MAX = 65504.0


@dataclass(frozen=True)
class Encoding:
    """One way to write a label.

    Attributes:
        suffix: of the file's name, with its dot. encode: an image to the file's bytes, the same for the same
            image. words: what the file holds and how to read it. decode: the file's bytes to the image, as
            the words say. step: between neighbouring values of its code, in the label's unit; 0 of floats.
    """

    suffix: str
    encode: Callable[[np.ndarray], bytes]
    words: str
    decode: Callable[[bytes], np.ndarray]
    step: float = 0.0


def encode_color(color: np.ndarray) -> np.ndarray:
    """Display values [...] in [0, 1] as uint8, to the nearest."""
    return np.rint(np.clip(color, 0, 1) * np.float32(255)).astype(np.uint8)


def encode_unit(values: np.ndarray) -> np.ndarray:
    """Linear values [...] in [0, 1] as uint16, to the nearest; larger ones are clipped."""
    return np.rint(np.clip(values, 0, 1) * np.float32(UINT16)).astype(np.uint16)


def encode_depth(depth_mm: np.ndarray, levels_per_mm: float = UINT16 / DEPTH_RANGE_MM) -> np.ndarray:
    """Z-depth [H, W] as uint16: 0 where there is none, or none in front; clipped at 65535."""
    raw = np.rint(depth_mm * np.float32(levels_per_mm))
    return np.clip(np.where(depth_mm > 0, np.maximum(raw, 1), 0), 0, UINT16).astype(np.uint16)


def encode_normals(normals: np.ndarray) -> np.ndarray:
    """Unit normals [H, W, 3] as uint16; 0 where the normal is 0, which is none."""
    raw = normals * np.float32(UINT16 / 2)
    raw += np.float32(UINT16 / 2 + 0.5)
    coded = raw.astype(np.uint16)
    coded[(normals[..., 0] == 0) & (normals[..., 1] == 0) & (normals[..., 2] == 0)] = 0
    return coded


def encode_flow(flow_px: np.ndarray) -> np.ndarray:
    """Flow [H, W, 2], NaN where there is none, as C3VD's uint16 [H, W, 3]: ±20 px, 0 none or beyond."""
    x, y = plane(flow_px, 0), plane(flow_px, 1)
    inside = (np.abs(x) <= FLOW_RANGE_PX) & (np.abs(y) <= FLOW_RANGE_PX)
    coded = np.zeros((*inside.shape, 3), np.uint16)
    for channel, values in enumerate((x, y)):
        raw = np.rint((values + np.float32(FLOW_RANGE_PX)) * np.float32(UINT16 / 2 / FLOW_RANGE_PX))
        coded[..., channel] = np.fmin(np.fmax(raw, 1), UINT16) * inside
    return coded


def decode_color(content: bytes) -> np.ndarray:
    """Values [...] of a file of 8 or 16 bits, in [0, 1]."""
    image = pixels(content)
    return image.astype(np.float32) / np.iinfo(image.dtype).max


def decode_depth(content: bytes, levels_per_mm: float = UINT16 / DEPTH_RANGE_MM) -> np.ndarray:
    """Z-depth float64 [H, W], mm, of ``encode_depth``; NaN where there is none, inf where it is clipped."""
    raw = pixels(content)
    return np.where(raw == 0, np.nan, np.where(raw == UINT16, np.inf, raw / levels_per_mm))


def decode_normals(content: bytes) -> np.ndarray:
    """Unit normals float64 [H, W, 3] of ``encode_normals``; 0 where there is none."""
    raw = pixels(content)
    return np.where((raw == 0).all(axis=-1, keepdims=True), 0, raw / (UINT16 / 2) - 1)


def decode_flow(content: bytes) -> np.ndarray:
    """Flow float64 [H, W, 2] of ``encode_flow``; NaN where there is none."""
    raw = pixels(content)[..., :2]
    flow_px = raw / (UINT16 / 2 / FLOW_RANGE_PX) - FLOW_RANGE_PX
    return np.where((raw == 0).all(axis=-1, keepdims=True), np.nan, flow_px)


def plane(image: np.ndarray, channel: int) -> np.ndarray:
    """One channel of an image [H, W, C] as float32 [H, W]."""
    return np.ascontiguousarray(image[..., channel], np.float32)


def half(radiance: np.ndarray) -> np.ndarray:
    """Values as float16, to the nearest; those beyond its range are clipped."""
    values = torch.from_numpy(np.ascontiguousarray(radiance, np.float32))  # NumPy takes ten times as long
    return values.clamp(max=HALF_MAX).half().numpy()


def depth_png(levels_per_mm: float, words: str) -> Encoding:
    """16-bit PNG depth of so many levels a millimetre."""
    return Encoding(
        ".png",
        lambda depth_mm: png(encode_depth(depth_mm, levels_per_mm)),
        words,
        lambda content: decode_depth(content, levels_per_mm),
        1 / levels_per_mm,
    )


def _none(depth_mm: np.ndarray) -> np.ndarray:
    """Depth [H, W] with NaN for 0."""
    return np.where(depth_mm == 0, np.nan, depth_mm)


_FLOW = (
    "R: x to the right, G: y down, raw / 65535 * 40 - 20 px (C3VD's code); 0, 0: none (no surface, no such "
    "frame, behind its lens, or beyond 20 px); {way}: the surface point of pixel p lies at p + flow there, "
    "seen "
    "or hidden"
)
_FLOW_FLOAT = (
    "{container}, 32-bit float: x to the right and y down, px, without limit; NaN: none (no surface, no such "
    "frame, or behind its lens); {way}, as in flow"
)
_BACK, _ON = "from this frame back to the previous one", "from this frame on to the next one"
_HIDDEN = (
    "8-bit: 255: the pixel's surface point is hidden or out of the picture in the {other} frame; 128: there "
    "is no surface, or no such frame; 0: it is seen there"
)

ENCODINGS: dict[str, Encoding] = {
    "rgb": Encoding(
        ".png",
        lambda color: png(encode_color(color)),
        "8-bit RGB, after the camera response; black where no surface is seen, save in gaps of a pixel or "
        "two within the surface, which take its colour: their depth is 0",
        decode_color,
        1 / 255,
    ),
    "rgb_linear": Encoding(
        ".png",
        lambda radiance: png(encode_unit(radiance)),
        "16-bit RGB radiance before the camera response, linear; 65535: display white and above (clipped)",
        decode_color,
        1 / UINT16,
    ),
    "rgb_exr": Encoding(
        ".exr",
        lambda radiance: exr(RGB=half(radiance)),
        "OpenEXR, channels R, G, B, 16-bit float: radiance before the camera response, linear; 1: display "
        "white; highlights above it are kept",
        lambda content: channels(content, "RGB"),
    ),
    "depth": Encoding(
        ".tiff",
        lambda depth_mm: deflated_tiff(encode_depth(depth_mm)),
        "16-bit z-depth, raw / 65535 * 100 mm; 0: none; 65535: 100 mm up (clipped)",
        decode_depth,
        DEPTH_RANGE_MM / UINT16,
    ),
    "depth_exr": Encoding(
        ".exr",
        lambda depth_mm: exr(Z=np.nan_to_num(depth_mm, nan=0).astype(np.float32)),
        "OpenEXR, channel Z, 32-bit float: z-depth in mm, not clipped; 0: none; below 0: behind the lens",
        lambda content: _none(channels(content, "Z")),
    ),
    "normals": Encoding(
        ".tiff",
        lambda normals: tiff(encode_normals(normals)),
        "16-bit RGB, raw / 65535 * 2 - 1 = x, y, z of the unit normal that points into the lumen, in camera "
        "axes; 0, 0, 0: none",
        decode_normals,
        2 / UINT16,
    ),
    "albedo": Encoding(
        ".png",
        lambda albedo: png(encode_unit(albedo)),
        "16-bit RGB base colour, linear, 65535: 1; black: none",
        decode_color,
        1 / UINT16,
    ),
    "roughness": Encoding(
        ".png",
        lambda values: png(encode_unit(values)),
        "16-bit roughness, 65535: 1; 0: none",
        decode_color,
        1 / UINT16,
    ),
    "metallic": Encoding(
        ".png", lambda values: png(encode_unit(values)), "16-bit metallic, 65535: 1", decode_color, 1 / UINT16
    ),
    "diffuse": Encoding(
        ".png",
        lambda color: png(encode_color(color)),
        "8-bit RGB as rgb, without specular reflection, and before the sensor",
        decode_color,
        1 / 255,
    ),
    "specular": Encoding(
        ".png",
        lambda color: png(encode_color(color)),
        "8-bit RGB: what specular reflection adds to diffuse, in display values",
        decode_color,
        1 / 255,
    ),
    "highlights": Encoding(
        ".png",
        png,
        "8-bit: 255: specular reflection adds more than 0.1 to each display value; 0: it does not",
        pixels,
    ),
    "flow": Encoding(
        ".tiff",
        lambda flow_px: deflated_tiff(encode_flow(flow_px)),
        "16-bit, " + _FLOW.format(way=_BACK),
        decode_flow,
        FLOW_STEP_PX,
    ),
    "flow_hidden": Encoding(".png", png, _HIDDEN.format(other="previous"), pixels),
    "flow_forward": Encoding(
        ".tiff",
        lambda flow_px: deflated_tiff(encode_flow(flow_px)),
        "16-bit, " + _FLOW.format(way=_ON),
        decode_flow,
        FLOW_STEP_PX,
    ),
    "flow_forward_hidden": Encoding(".png", png, _HIDDEN.format(other="next"), pixels),
    **{
        f"{name}_{suffix[1:]}": Encoding(suffix, encode, _FLOW_FLOAT.format(container=held, way=way), decode)
        for name, way in (("flow", _BACK), ("flow_forward", _ON))
        for suffix, encode, held, decode in (
            (
                ".exr",
                lambda flow_px: exr(X=plane(flow_px, 0), Y=plane(flow_px, 1)),
                "OpenEXR, channels X, Y",
                lambda content: channels(content, "X", "Y"),
            ),
            (
                ".npz",
                lambda flow_px: npz(flow=flow_px.astype(np.float32, copy=False)),
                "NumPy, array flow [H, W, 2]",
                lambda content: np.load(BytesIO(content))["flow"].astype(np.float64),
            ),
        )
    },
    "occlusion": Encoding(
        ".png",
        png,
        "8-bit (C3VD's): 255: the surface hides other surface behind it, within 100 mm of the camera; 0: not",
        pixels,
    ),
    "mask": Encoding(
        ".png",
        png,
        "8-bit: 255: surface that the training photos show; 128: measured, but shown by none of them (its "
        "materials are a guess); 64: filled in (its shape is a guess too); 0: no surface",
        pixels,
    ),
    "polyp": Encoding(
        ".png",
        png,
        "8-bit: number of the polyp that is seen, counted from 1 (see polyps in dataset.json); 0: none",
        pixels,
    ),
    "fluid": Encoding(
        ".png",
        png,
        "8-bit: number of the patch of fluid that is seen, counted from 1 (see fluids in dataset.json for "
        "its kind); 0: bare tissue",
        pixels,
    ),
    "overlay": Encoding(
        ".png",
        png,
        "8-bit: 255: the processor's overlay hides what the photo would show here; 0: it does not",
        pixels,
    ),
    "triangles": Encoding(
        ".tiff",
        deflated_tiff,
        "32-bit signed: index of the triangle in surface.ply, counted from 0; -1: none",
        lambda content: tifffile.imread(BytesIO(content)),
    ),
    **{
        name: Encoding(
            ".exr",
            lambda moved_mm: exr(X=plane(moved_mm, 0), Y=plane(moved_mm, 1), Z=plane(moved_mm, 2)),
            f"OpenEXR, channels X, Y, Z, 32-bit float: the tissue's own motion {way}, mm, along the world's "
            "axes (the camera's is in the poses); NaN: none (no surface, or no such frame)",
            lambda content: channels(content, "X", "Y", "Z"),
        )
        for name, way in (("scene_flow", _BACK), ("scene_flow_forward", _ON))
    },
    "vertices": Encoding(
        ".npz",
        lambda vertices_mm: npz(vertices_mm=vertices_mm.astype(np.float32, copy=False)),
        "NumPy, array vertices_mm [V, 3], 32-bit float: the vertices of surface.ply (which has them at rest) "
        "in this frame, world, mm",
        lambda content: np.load(BytesIO(content))["vertices_mm"].astype(np.float64),
    ),
}

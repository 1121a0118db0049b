"""Small sequences in every layout, and ways to damage one of their files."""

import codecs
import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import tifffile
from hypothesis import strategies as st
from PIL import Image

WIDTH, HEIGHT, FRAMES = 16, 12, 3
CAMERA = {"model": "pinhole", "width": WIDTH, "height": HEIGHT, "fx": 10, "fy": 10, "cx": 7.5, "cy": 5.5}
ROTATION_AND_PLACE = np.eye(4)
SIMCOL_SIZE = 475
HEAD = 200
"""Bytes at the beginning of a file, which say what it is."""

ODD_NUMBERS = ["nan", "inf", "-inf", "1e400", "-0", "9" * 400, "1e308", "x", "", "0x10", "1_0", "½", "-1"]
ODD_VALUES = [
    None,
    True,
    -1,
    0,
    1e308,
    -1e308,
    10**400,
    10**9,
    0.5,
    "x",
    "",
    [],
    {},
    [[]],
    {"a": 1},
    float("nan"),
]


def _photo(path: Path, index: int, size: tuple[int, int] = (HEIGHT, WIDTH)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.random.default_rng(index).integers(0, 255, (*size, 3), np.uint8)).save(path)


def _depth(path: Path, size: tuple[int, int] = (HEIGHT, WIDTH)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    raw = np.full(size, 9000, np.uint16)
    tifffile.imwrite(path, raw) if path.suffix == ".tiff" else Image.fromarray(raw).save(path)


def write_c3vd(folder: Path) -> Path:
    for index in range(FRAMES):
        _photo(folder / f"{index:04d}_color.png", index)
        _depth(folder / f"{index:04d}_depth.tiff")
    (folder / "pose.txt").write_text("1,0,0,0,0,1,0,0,0,0,1,0,2,3,4,1\n" * FRAMES)
    (folder / "camera.json").write_text(json.dumps(CAMERA))
    return folder


def write_c3vd_v2(folder: Path) -> Path:
    for index in range(FRAMES):
        _photo(folder / f"rgb/{index:04d}.jpg", index)
        _depth(folder / f"depth/{index:04d}.tiff")
    (folder / "pose.txt").write_text("1,0,0,0,0,1,0,0,0,0,1,0,2,3,4,1\n" * FRAMES)
    omni = {
        "model": "omni",
        "width": WIDTH,
        "height": HEIGHT,
        "cx": 8,
        "cy": 6,
        "a0": 9,
        "a2": -0.01,
        "a3": 0,
        "a4": 0,
    }
    (folder / "camera.json").write_text(json.dumps(omni))
    return folder


def write_transforms(folder: Path) -> Path:
    frames = []
    for index in range(FRAMES):
        _photo(folder / f"images/{index}.png", index)
        _depth(folder / f"depth/{index}.png")
        frames.append({"file_path": f"images/{index}.png", "transform_matrix": np.eye(4).tolist()})
    camera = {"w": WIDTH, "h": HEIGHT, "fl_x": 10.0, "fl_y": 10.0, "cx": 8.0, "cy": 6.0, "k1": 0.01}
    (folder / "transforms.json").write_text(json.dumps({**camera, "unit": "mm", "frames": frames}))
    return folder


def write_transforms_npy(folder: Path) -> Path:
    write_transforms(folder)
    for index in range(FRAMES):
        (folder / f"depth/{index}.png").unlink()
        np.save(folder / f"depth/{index}.npy", np.full((HEIGHT, WIDTH), 9.0, np.float32))
    content = json.loads((folder / "transforms.json").read_text())
    content["camera_model"] = "OPENCV_FISHEYE"
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def write_transforms_masked(folder: Path) -> Path:
    write_transforms(folder)
    content = json.loads((folder / "transforms.json").read_text())
    (folder / "masks").mkdir()
    for index, frame in enumerate(content["frames"]):
        Image.fromarray(np.full((HEIGHT, WIDTH), 255, np.uint8)).save(folder / f"masks/{index}.png")
        frame["mask_path"] = f"masks/{index}.png"
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def write_c3vd_exr(folder: Path) -> Path:
    write_c3vd(folder)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    for index in range(FRAMES):
        (folder / f"{index:04d}_depth.tiff").unlink()
        depth_mm = np.full((HEIGHT, WIDTH), 14.0, np.float32)
        OpenEXR.File(header, {"Z": depth_mm}).write(str(folder / f"{index:04d}_depth.exr"))
    return folder


def write_c3vd_v2_npz(folder: Path) -> Path:
    write_c3vd_v2(folder)
    for index in range(FRAMES):
        (folder / f"depth/{index:04d}.tiff").unlink()
        np.savez(folder / f"depth/{index:04d}.npz", depth=np.full((HEIGHT, WIDTH), 14.0))
    return folder


def write_c3vd_float(folder: Path) -> Path:
    write_c3vd(folder)
    for index in range(FRAMES):
        tifffile.imwrite(folder / f"{index:04d}_depth.tiff", np.full((HEIGHT, WIDTH), 14.0, np.float32))
    return folder


def write_transforms_split(folder: Path) -> Path:
    write_transforms(folder)
    content = json.loads((folder / "transforms.json").read_text())
    (folder / "transforms.json").unlink()
    for name, frames in (("train", content["frames"][1:]), ("test", content["frames"][:1])):
        (folder / f"transforms_{name}.json").write_text(json.dumps({**content, "frames": frames}))
    return folder


def write_simcol(folder: Path) -> Path:
    size = (SIMCOL_SIZE, SIMCOL_SIZE)
    _photo(folder / "FrameBuffer_0000.png", 0, size)
    _depth(folder / "Depth_0000.png", size)
    (folder / "SavedPosition.txt").write_text("1 2 3\n")
    (folder / "SavedRotationQuaternion.txt").write_text("0 0 0 1\n")
    (folder / "cam.txt").write_text("230 0 236 0 231 238 0 0 1\n")
    return folder


def write_tum(folder: Path) -> Path:
    rows = {"rgb": [], "depth": [], "groundtruth": []}
    for index in range(FRAMES):
        _photo(folder / f"rgb/{index}.png", index)
        _depth(folder / f"depth/{index}.png")
        rows["rgb"].append(f"{index}.0 rgb/{index}.png")
        rows["depth"].append(f"{index}.0 depth/{index}.png")
        rows["groundtruth"].append(f"{index}.0 1 2 3 0 0 0 1")
    for name, lines in rows.items():
        (folder / f"{name}.txt").write_text("# a comment\n" + "\n".join(lines) + "\n")
    (folder / "calibration.txt").write_text("10 10 7.5 5.5\n")
    return folder


WRITERS: dict[str, Callable[[Path], Path]] = {
    writer.__name__.removeprefix("write_"): writer
    for writer in (
        write_c3vd,
        write_c3vd_exr,
        write_c3vd_float,
        write_c3vd_v2,
        write_c3vd_v2_npz,
        write_transforms,
        write_transforms_masked,
        write_transforms_npy,
        write_transforms_split,
        write_simcol,
        write_tum,
    )
}


class Files(dict):
    """Paths and their bytes, which nobody wants to read."""

    def __repr__(self) -> str:
        return f"{len(self)} files"


def files_of(folder: Path) -> Files:
    """Every file under ``folder``."""
    return Files({path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()})


@st.composite
def damaged(draw: st.DrawFn, contents: dict[Path, bytes]) -> tuple[Path, bytes]:
    """One of the files and its damaged bytes: cut short, bits flipped, another file's, odd values, a mark at
    its head, nested without end, or claiming to be huge."""
    path = draw(st.sampled_from(sorted(contents)))
    content = contents[path]
    kinds = ["cut", "flip", "swap", "noise"]
    kinds += {
        ".txt": ["number"] * 4 + ["mark"],
        ".json": ["value"] * 6 + ["mark", "deep"],
        ".png": ["huge"],
    }.get(path.suffix, [])
    kind = draw(st.sampled_from(kinds))
    if kind == "cut":
        return path, content[: draw(st.integers(0, max(0, len(content) - 1)))]
    if kind == "flip":
        spoilt = bytearray(content)
        for _ in range(draw(st.integers(1, 4))):
            end = min(len(spoilt), draw(st.sampled_from([HEAD, len(spoilt)])))
            spoilt[draw(st.integers(0, end - 1))] ^= 1 << draw(st.integers(0, 7))
        return path, bytes(spoilt)
    if kind == "swap":
        return path, contents[draw(st.sampled_from(sorted(contents)))]
    if kind == "noise":
        return path, draw(st.binary(max_size=64))
    if kind == "mark":
        return path, codecs.BOM_UTF8 + content
    if kind == "deep":
        return path, draw(st.sampled_from([b"[", b'{"a":'])) * 20_000
    if kind == "huge":
        return path, _claiming(content, draw(st.sampled_from([0, 60_000, 2**31 - 1])))
    if kind == "number":
        words = content.decode().replace(",", " , ").split(" ")
        words[draw(st.integers(0, len(words) - 1))] = draw(st.sampled_from(ODD_NUMBERS))
        return path, " ".join(words).encode()
    return path, _with_odd_value(draw, json.loads(content))


def _claiming(png: bytes, size: int) -> bytes:
    """The PNG file with a header that says it is ``size`` pixels wide and high."""
    header = b"IHDR" + struct.pack(">II", size, size) + png[24:29]
    return png[:12] + header + struct.pack(">I", zlib.crc32(header)) + png[33:]


def _with_odd_value(draw: st.DrawFn, document: object) -> bytes:
    """JSON with one value, somewhere in it, replaced or removed."""
    place = document
    while True:
        keys = list(place) if isinstance(place, dict) else list(range(len(place)))
        key = draw(st.sampled_from(keys))
        inner = place[key]
        if isinstance(inner, dict | list) and inner and draw(st.integers(0, 3)):
            place = inner
            continue
        if draw(st.integers(0, 5)):
            place[key] = draw(st.sampled_from(ODD_VALUES))
        else:
            del place[key]
        return json.dumps(document).encode()

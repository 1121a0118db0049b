"""A reader of OpenEXR files that shares no code with the library: scan lines, run lengths or none ("OpenEXR
File Layout", openexr.com)."""

import struct

import numpy as np

NONE, RLE = b"\0", b"\1"
"""Compressions whose blocks are of one scan line each."""

DTYPES = {1: np.dtype("<f2"), 2: np.dtype("<f4")}


def read(content: bytes) -> tuple[dict[str, bytes], dict[str, np.ndarray]]:
    """Attributes of the header, as bytes, and the channels, float16 or float32 [H, W]."""
    assert struct.unpack_from("<II", content) == (20000630, 2)
    attributes, at = {}, 8
    while content[at]:
        name, kind, _ = content[at:].split(b"\0", 2)
        at += len(name) + len(kind) + 2
        (size,) = struct.unpack_from("<I", content, at)
        attributes[name.decode()] = content[at + 4 : at + 4 + size]
        at += 4 + size
    assert attributes["compression"] in (NONE, RLE)
    left, top, right, bottom = struct.unpack("<4i", attributes["dataWindow"])
    width, height = right - left + 1, bottom - top + 1
    names = _channels(attributes["channels"])
    planes = {name: np.empty((height, width), dtype) for name, dtype in names.items()}
    for offset in struct.unpack_from(f"<{height}Q", content, at + 1):
        line, size = struct.unpack_from("<iI", content, offset)
        expected = width * sum(dtype.itemsize for dtype in names.values())
        block = _spread(content[offset + 8 : offset + 8 + size], expected)
        for name, dtype in names.items():
            row, block = block[: width * dtype.itemsize], block[width * dtype.itemsize :]
            planes[name][line - top] = np.frombuffer(row, dtype)
    return attributes, planes


def _channels(described: bytes) -> dict[str, np.dtype]:
    channels = {}
    while described[0]:
        name, rest = described.split(b"\0", 1)
        channels[name.decode()] = DTYPES[struct.unpack_from("<I", rest)[0]]
        described = rest[16:]
    return channels


def _spread(block: bytes, size: int) -> bytes:
    """The bytes of a block: runs spread out, summed up, its halves interleaved; stored where that is as
    small."""
    if len(block) == size:
        return block
    spread = bytearray()
    while block:
        (count,) = struct.unpack_from("b", block)
        taken = 2 if count >= 0 else 1 - count
        spread += block[1:2] * (count + 1) if count >= 0 else block[1:taken]
        block = block[taken:]
    differences = np.frombuffer(spread, np.uint8).astype(np.int64)
    differences[1:] -= 128
    summed = np.cumsum(differences).astype(np.uint8)
    mixed = np.empty(size, np.uint8)
    mixed[::2], mixed[1::2] = summed[: (size + 1) // 2], summed[(size + 1) // 2 :]
    return mixed.tobytes()

"""Photos and depth maps from files: complete or not at all, safe to call from several threads."""

from __future__ import annotations

import logging
import struct
import zlib
from io import SEEK_END, BytesIO
from pathlib import Path
from threading import Lock

import cv2
import numpy as np
import tifffile
from PIL import Image

from endotwin.errors import SequenceError
from endotwin.run.output import whole_file
from endotwin.sequence import floatdepth

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_END = b"IEND\xaeB`\x82"
JPEG_SIGNATURE, JPEG_END = b"\xff\xd8", b"\xff\xd9"
TIFF_SIGNATURES = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")
TIFF_OWN_COMPRESSIONS = (1, 8, 32946)  # none and deflate, which tifffile decodes by itself
LARGEST_PIXELS = 1 << 30  # that OpenCV decodes
TRAILING_BYTES = 64  # what may follow the end marker of a complete JPEG
EXIF_ORIENTATION = 0x0112
OPENCV_LOG = Lock()  # its level is one for the whole process

# A damaged file is told in our own error; without a handler, tifffile's log of it would go to stderr as well.
logging.getLogger("tifffile").addHandler(logging.NullHandler())


def read_color(path: Path) -> np.ndarray:
    """A photo, uint8 [H, W, 3], RGB. Raises SequenceError where the file is damaged or no image."""
    content = _complete_bytes(path)
    image = _decoded(path, content, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def unclipped(photo: np.ndarray) -> np.ndarray:
    """Bool [H, W]: where no channel of a photo uint8 [H, W, 3] is 0 or 255."""
    return cv2.inRange(photo, (1, 1, 1), (254, 254, 254)) > 0


def write_png(path: Path, image: np.ndarray, overwrite: bool = False) -> None:
    """Write uint8 [H, W, 3], RGB, as the PNG file ``path``, whole or not at all; raises OutputError."""
    content = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes()
    with whole_file(path, overwrite) as beside:
        beside.write_bytes(content)


UNREADABLE = (OSError, ValueError, TypeError, SyntaxError, Image.DecompressionBombError)
"""What Pillow raises for files whose header it cannot read."""


def read_plane(path: Path) -> np.ndarray:
    """A depth file as stored, [H, W]; of several channels, the first. Raises SequenceError where damaged."""
    if path.suffix.lower() in floatdepth.SUFFIXES:
        return floatdepth.read_array(path)
    plane = _decoded(path, _complete_bytes(path), cv2.IMREAD_UNCHANGED)
    return plane if plane.ndim == 2 else np.ascontiguousarray(plane[..., 0])


def written_size(path: Path) -> tuple[int, int] | None:
    """Width and height of an image as its header says; None where that cannot be read, or no PNG's or JPEG's
    end shows that the file is whole."""
    try:
        with path.open("rb") as file, Image.open(file) as photo:
            size = photo.size
            file.seek(-min(TRAILING_BYTES, path.stat().st_size), SEEK_END)
            end = file.read()
    except UNREADABLE:
        return None
    return size if PNG_END in end or JPEG_END in end else None


def orientation(path: Path) -> int:
    """How a photo's EXIF says that it is to be turned, 1 to 8; 1, not at all, where it says nothing."""
    try:
        with Image.open(path) as photo:
            return int(photo.getexif().get(EXIF_ORIENTATION, 1))
    except UNREADABLE:
        return 1


def _decoded(path: Path, content: np.ndarray, mode: int) -> np.ndarray:
    """The image in a file's bytes; raises SequenceError where there is none, or one too large to hold."""
    image = None
    try:
        if _is_tiff(content):
            image = _decode_tiff(path, content, mode)
        elif len(content):
            image = cv2.imdecode(content, mode)
    except (cv2.error, MemoryError) as error:
        raise _endless(path) from error
    if image is None or not image.size:
        raise _damaged(path)
    return image


def _damaged(path: Path) -> SequenceError:
    return SequenceError(f"{path} is truncated or not an image; copy or download the file again")


def _endless(path: Path) -> SequenceError:
    return SequenceError(f"{path} says that it is larger than any image, or empty; copy the file again")


def _complete_bytes(path: Path) -> np.ndarray:
    """The file's bytes, uint8 [N], once its end marker shows that none are missing."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise SequenceError(f"{path} cannot be read ({error.strerror}); check the file") from error
    if content.startswith(PNG_SIGNATURE):
        if not _png_is_whole(content):
            raise _damaged(path)
        if not 0 < _png_pixels(content) <= LARGEST_PIXELS:
            raise _endless(path)
    if content.startswith(JPEG_SIGNATURE) and JPEG_END not in content[-TRAILING_BYTES:]:
        raise _damaged(path)
    return np.frombuffer(content, np.uint8)


def _png_is_whole(content: bytes) -> bool:
    """Whether every chunk up to IEND is there with the right checksum: libpng would print and carry on."""
    position = len(PNG_SIGNATURE)
    while position + 12 <= len(content):
        (length,) = struct.unpack_from(">I", content, position)
        end = position + 8 + length
        if end + 4 > len(content):
            return False
        (checksum,) = struct.unpack_from(">I", content, end)
        if zlib.crc32(memoryview(content)[position + 4 : end]) != checksum:
            return False
        if content[position + 4 : position + 8] == b"IEND":
            return True
        position = end + 4
    return False


def _png_pixels(content: bytes) -> int:
    """How many pixels a whole PNG file says that it has: libpng would print that they are too many."""
    width, height = struct.unpack_from(">II", content, len(PNG_SIGNATURE) + 8)
    return width * height


def _is_tiff(content: np.ndarray) -> bool:
    return bytes(content[:4]) in TIFF_SIGNATURES


def _decode_tiff(path: Path, content: np.ndarray, mode: int) -> np.ndarray | None:
    """The first page, its layout checked before libtiff sees it, because libtiff prints what it dislikes."""
    try:
        with tifffile.TiffFile(BytesIO(content)) as tiff:
            page = tiff.pages[0]
            ends = np.add(page.dataoffsets, page.databytecounts)
            if not len(ends) or ends.max() > len(content) or min(page.databytecounts) < 1:
                return None
            plain = page.compression in TIFF_OWN_COMPRESSIONS and page.predictor in (1, 2)
            if plain and mode == cv2.IMREAD_UNCHANGED:
                return page.asarray()
    except Exception as error:  # tifffile raises whatever the wrong bytes lead it to
        raise _damaged(path) from error
    with OPENCV_LOG:
        level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        try:
            return cv2.imdecode(content, mode)
        finally:
            cv2.utils.logging.setLogLevel(level)

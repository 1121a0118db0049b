"""Files of images: what is written is what readers that are not ours find in them."""

from __future__ import annotations

import zlib
from io import BytesIO

import cv2
import numpy as np
import OpenEXR
import pytest
import tifffile
from PIL import Image

from endotwin.synth.containers import deflated_tiff, exr, pixels, png, tiff

SHAPES = ((7, 5), (7, 5, 3), (1, 1), (480, 640, 3))


def noise(shape: tuple[int, ...], dtype: type) -> np.ndarray:
    limits = np.iinfo(dtype)
    return np.random.default_rng(0).integers(limits.min, limits.max, shape, dtype, endpoint=True)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", SHAPES)
def test_png_holds_the_image_for_opencv(shape, dtype):
    image = noise(shape, dtype)
    found = cv2.imdecode(np.frombuffer(png(image), np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(found if image.ndim == 2 else found[..., ::-1], image)
    np.testing.assert_array_equal(pixels(png(image)), image)


def test_png_holds_the_image_for_pillow_which_checks_the_sums():
    image = noise((7, 5, 3), np.uint8)
    np.testing.assert_array_equal(Image.open(BytesIO(png(image))), image)
    content = png(image)
    assert int.from_bytes(content[29:33], "big") == zlib.crc32(content[12:29])


def test_png_of_columns_of_an_image_is_that_of_their_copy():
    image = noise((8, 6, 3), np.uint16)
    assert png(image[:, ::2]) == png(image[:, ::2].copy())


@pytest.mark.parametrize("write", [tiff, deflated_tiff])
@pytest.mark.parametrize("dtype", [np.uint16, np.int32])
@pytest.mark.parametrize("shape", SHAPES)
def test_tiff_holds_the_image_for_tifffile_and_opencv(shape, dtype, write):
    image = noise(shape, dtype)
    np.testing.assert_array_equal(tifffile.imread(BytesIO(write(image))), image)
    if dtype is np.uint16:
        np.testing.assert_array_equal(pixels(write(image)), image)
    else:
        found = cv2.imdecode(np.frombuffer(write(image), np.uint8), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(found if image.ndim == 2 else found[..., ::-1], image)


@pytest.mark.parametrize("names", ["Z", "YX", "XYZ"])
@pytest.mark.parametrize("shape", [(7, 5), (1, 1), (480, 640)])
def test_exr_of_floats_is_what_the_library_writes(shape, names):
    planes = np.random.default_rng(0).normal(size=(len(names), *shape)).astype(np.float32)
    planes[0, 0, 0] = np.nan
    channels, file = dict(zip(names, planes, strict=True)), BytesIO()
    header = {"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, dict(channels), num_threads=0).write(file)
    assert exr(**channels) == file.getvalue()

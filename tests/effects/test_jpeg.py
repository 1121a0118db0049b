"""A photo's life as a JPEG picture: its quality comes out as it was put in, and no other photo has one."""

from io import BytesIO

import cv2
import numpy as np
import pytest
from photos import levels, textured
from PIL import Image

from endotwin.effects.jpeg import quality_in, quality_of
from endotwin.sequence.images import write_png
from endotwin.sequence.readers import open_sequence

SEEDS = range(3)


def photo(seed: int, noise_levels: float = 1.0) -> np.ndarray:
    return levels(textured(seed, 120, 160), noise_levels, seed)


def coded(image: np.ndarray, kind: str = "JPEG", **options: float) -> np.ndarray:
    """Through Pillow's encoder and back."""
    content = BytesIO()
    Image.fromarray(image).save(content, kind, **options)
    return np.array(Image.open(content))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("halved", [0, 2])
@pytest.mark.parametrize("quality", [10, 30, 50, 75, 90, 92, 97, 100])
def test_the_quality_is_that_which_was_put_in(seed, halved, quality):
    """Or the next one, where the two differ in steps that no coefficient of the photo reaches."""
    found = quality_in(coded(photo(seed), quality=quality, subsampling=halved))
    assert found == pytest.approx(quality, abs=1)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("noise_levels", [0, 0.3, 2, 8])
def test_a_photo_that_was_never_coded_has_none(seed, noise_levels):
    assert quality_in(photo(seed, noise_levels=noise_levels)) is None


@pytest.mark.parametrize("seed", SEEDS)
def test_of_two_codings_the_last_one_is_told(seed):
    assert quality_in(coded(coded(photo(seed), quality=60), quality=85)) == 85
    assert quality_in(coded(coded(photo(seed), quality=85), quality=60)) == 60


@pytest.mark.parametrize(
    "change",
    [
        lambda image: image[3:, 5:],
        lambda image: cv2.resize(image, (150, 110), interpolation=cv2.INTER_AREA),
        lambda image: np.clip(1.1 * image, 0, 255).round().astype(np.uint8),
        lambda image: coded(image, "WEBP", quality=80),
    ],
    ids=["cropped", "resized", "brighter", "webp"],
)
def test_a_photo_that_was_changed_since_tells_none(change):
    assert quality_in(change(coded(photo(0), quality=80))) is None


def test_pictures_without_noise_or_too_small_tell_none():
    """Blocks that repeat are one observation, and a ramp of whole levels is no rounded one."""
    v, u = np.mgrid[:120, :160]
    for shade in (u // 4 + 1, u + 1, 8 * ((u // 8 + v // 8) % 2) + 100, np.full((120, 160), 90)):
        assert quality_in(np.repeat(np.uint8(shade)[..., None], 3, axis=2)) is None
    assert quality_in(photo(0)[:7]) is None
    assert quality_in(np.repeat(np.repeat(photo(0)[:60, :80], 2, axis=0), 2, axis=1)) is None
    assert quality_in(photo(0) // 16 * 16) is None


def test_photos_of_an_h264_video_tell_none():
    pytest.importorskip("av")
    from endotwin.effects.video import Clip, Video

    for bitrate in (0.3, 3.0, 30.0):
        clip = Clip()
        for seed in SEEDS:
            played = clip.recorded(np.float32(photo(seed)) / 255, Video(bitrate))
            assert quality_in(np.rint(255 * played).astype(np.uint8)) is None


def test_a_png_file_tells_what_the_jpeg_file_before_it_did(tmp_path):
    cv2.imwrite(str(tmp_path / "a.jpg"), photo(0), [cv2.IMWRITE_JPEG_QUALITY, 83])
    write_png(tmp_path / "a.png", cv2.imread(str(tmp_path / "a.jpg"))[..., ::-1])
    assert quality_of(tmp_path / "a.png") == quality_of(tmp_path / "a.jpg") == 83


@pytest.mark.parametrize(
    "name, quality",
    [
        *((f"colon_{kind}", None) for kind in ("direct", "gi", "offset", "fisheye", "bounce", "wet")),
        *(("colon_scope", 92), ("c3vd_cecum", None)),
    ],
)
def test_path_traced_colons_tell_what_their_maker_put_in(data_root, name, quality):
    files = open_sequence(data_root / name).color_files
    assert {quality_of(file) for file in files[::3]} == {quality}

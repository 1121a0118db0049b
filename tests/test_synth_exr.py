"""EXR labels, read by a reader of the tests' own: radiance and depth that no range clips."""

import json
import tarfile
from dataclasses import replace
from pathlib import Path

import exr_file
import numpy as np
import pytest
import torch
import tube_twin
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from endotwin.light import shading
from endotwin.render import Renderer
from endotwin.sequence.readers import open_sequence
from endotwin.synth import LAYOUTS, Trajectory, synthesize
from endotwin.synth.encodings import ENCODINGS

HALF_ROUNDING = 2.0**-11
SUBNORMAL = 2.0**-25
"""Greatest relative error of rounding to float16, and the absolute one below its normal range."""

REQUIRED_ATTRIBUTES = {
    *("channels", "compression", "dataWindow", "displayWindow", "lineOrder"),
    *("pixelAspectRatio", "screenWindowCenter", "screenWindowWidth"),
}


@pytest.fixture(scope="module")
def twin():
    """A tube so brightly lit that much of it is beyond display white."""
    twin = tube_twin.fitted(tube_twin.seen(tube_twin.surface()))
    return replace(twin, light=replace(twin.light, L0=200 * twin.light.L0))


@pytest.fixture(scope="module")
def trajectory():
    poses = np.stack([tube_twin.pose(s) for s in (0.2, 0.35)])
    return Trajectory(poses, np.array([0.0, 0.1]), "two poses")


def exr_files(folder: Path, label: str) -> list[bytes]:
    """Content of the EXR files of a label, frame by frame, from the tars of the dataset too."""
    found = {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*.exr")}
    for each in folder.glob("*.tar"):
        with tarfile.open(each) as tar:
            members = [member for member in tar if member.name.endswith(".exr")]
            found |= {member.name: tar.extractfile(member).read() for member in members}
    return [found[name] for name in sorted(found) if label in name]


def rgb(planes: dict[str, np.ndarray]) -> np.ndarray:
    return np.stack([planes[channel] for channel in "RGB"], axis=-1)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_holds_the_radiance_and_depth_of_each_frame_and_says_so(
    twin, trajectory, tmp_path, layout
):
    labels = ("rgb", "rgb_exr", "depth", "depth_exr")
    synthesize(twin, trajectory, tmp_path / "d", labels=labels, layout=layout)
    colors, depths = (exr_files(tmp_path / "d", label) for label in ("rgb_exr", "depth_exr"))
    assert len(colors) == len(depths) == 2
    for T_world_camera, color, depth in zip(trajectory.T_world_camera, colors, depths, strict=True):
        view = Renderer(twin).view(T_world_camera)
        assert view.radiance.max() > 2
        np.testing.assert_allclose(
            rgb(exr_file.read(color)[1]), view.radiance, rtol=HALF_ROUNDING, atol=SUBNORMAL
        )
        (plane,) = exr_file.read(depth)[1].values()
        assert plane.dtype == np.float32
        np.testing.assert_array_equal(plane, np.nan_to_num(view.depth_mm))
    words = json.loads((tmp_path / "d" / "dataset.json").read_text())["conventions"]
    assert "OpenEXR" in words["rgb_exr"] and "mm" in words["depth_exr"]
    if LAYOUTS[layout].reads:
        sequence = open_sequence(tmp_path / "d" / LAYOUTS[layout].root)
        assert len(sequence) == 2 and sequence.frame(0).color.shape == (72, 96, 3)


def test_the_response_of_the_radiance_is_the_photo(twin, trajectory, tmp_path):
    synthesize(twin, trajectory, tmp_path / "d", labels=("rgb", "rgb_exr", "depth"))
    radiance = rgb(exr_file.read(exr_files(tmp_path / "d", "rgb_exr")[1])[1]).astype(np.float32)
    photo = open_sequence(tmp_path / "d").frame(1).color
    expected = shading.respond(torch.from_numpy(radiance), twin.response.gamma).clamp(0, 1).numpy() * 255
    assert 0.02 < (photo == 255).mean() < 0.9
    assert np.abs(photo - expected).max() < 0.5 + 255 * HALF_ROUNDING


@given(
    arrays.arrays(
        np.float32,
        st.tuples(st.integers(1, 40), st.integers(1, 9)),
        elements=st.floats(0, 2.0**127, width=32),
    )
)
def test_any_radiance_reads_back_rounded_to_a_half_and_no_highlight_is_infinite(values):
    radiance = np.stack([values, values[::-1], values[:, ::-1]], axis=-1)
    read = rgb(exr_file.read(ENCODINGS["rgb_exr"].encode(radiance))[1])
    assert read.dtype == np.float16
    np.testing.assert_allclose(
        read.astype(float), np.minimum(radiance, 65504.0), rtol=HALF_ROUNDING, atol=SUBNORMAL
    )


def test_depth_beyond_100_mm_and_behind_the_lens_is_kept_and_none_is_0():
    depth_mm = np.array([[np.nan, 0.125, 100.5, 4321.0625, -3.5]], np.float32)
    planes = exr_file.read(ENCODINGS["depth_exr"].encode(depth_mm))[1]
    np.testing.assert_array_equal(planes["Z"], [[0, 0.125, 100.5, 4321.0625, -3.5]])


def test_the_header_holds_what_the_format_requires_and_nothing_of_the_moment():
    radiance = np.random.default_rng(0).random((40, 30, 3), np.float32)
    content = ENCODINGS["rgb_exr"].encode(radiance)
    assert set(exr_file.read(content)[0]) <= REQUIRED_ATTRIBUTES | {"type"}
    assert content == ENCODINGS["rgb_exr"].encode(radiance.copy(order="F"))

"""Depth as floating-point numbers, in every container and layout that holds it."""

from functools import partial

import numpy as np
import OpenEXR
import pytest
import tifffile
import tube_twin
from c3vd_folder import H, W, write_c3vd

import endotwin
from endotwin.errors import SequenceError
from endotwin.sequence.readers import c3vd, open_sequence, transforms, tum


def save_exr(path, depth: np.ndarray) -> None:
    header = {"compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"Z": depth, "A": np.ones_like(depth)}).write(str(path))


SAVERS = {
    "npy": np.save,
    "npz": lambda path, depth: np.savez_compressed(path, depth=depth, other=1),
    "exr": save_exr,
    "tiff": tifffile.imwrite,
}
READERS = {
    "c3vd": (c3vd.read_depth_mm, 1),
    "tum": (tum.read_depth_mm, 1000),
    "transforms": (partial(transforms.read_depth_mm, level_mm=10), 10),
}


def some_depth(seed: int = 0) -> np.ndarray:
    """Float32 [H, W] from 20 to 60."""
    return np.random.default_rng(seed).uniform(20, 60, (H, W)).astype(np.float32)


@pytest.mark.parametrize("suffix", SAVERS)
@pytest.mark.parametrize("layout", READERS)
def test_it_is_in_the_unit_of_the_layout_and_what_is_no_distance_is_none(tmp_path, suffix, layout):
    read, unit_mm = READERS[layout]
    depth_mm = some_depth()
    written = depth_mm / unit_mm
    written[0, :5] = np.nan, -1, 0, np.inf, 1e10
    SAVERS[suffix](tmp_path / f"depth.{suffix}", written)
    found = read(tmp_path / f"depth.{suffix}")
    assert np.isnan(found[0, :5]).all() and found.dtype == np.float32
    np.testing.assert_allclose(found[1:], depth_mm[1:], rtol=1e-6)


@pytest.fixture(params=SAVERS)
def folder(request, tmp_path):
    """A sequence in C3VD's layout with floating-point depth."""
    folder = write_c3vd(tmp_path / "c3vd")
    for index, file in enumerate(sorted(folder.glob("*_depth.tiff"))):
        file.unlink()
        SAVERS[request.param](file.with_suffix(f".{request.param}"), some_depth(index))
    return folder


def test_it_is_found_in_both_versions_of_c3vd(folder):
    np.testing.assert_allclose(open_sequence(folder).depth_mm(2), some_depth(2), rtol=1e-6)
    for kind, name in (("rgb", "color"), ("depth", "depth")):
        (folder / kind).mkdir()
        for file in folder.glob(f"*_{name}.*"):
            file.rename(folder / kind / file.name.replace(f"_{name}", ""))
    np.testing.assert_allclose(open_sequence(folder).depth_mm(2), some_depth(2), rtol=1e-6)


@pytest.mark.parametrize("kept", [0, 10, 0.5, -3])
def test_a_truncated_file_is_refused_by_name_and_nothing_is_printed(folder, capfd, kept):
    (file,) = folder.glob("0002_depth.*")
    content = file.read_bytes()
    file.write_bytes(content[: int(kept * len(content)) if kept == 0.5 else kept])
    with pytest.raises(SequenceError, match=file.name):
        open_sequence(folder).depth_mm(2)
    assert capfd.readouterr() == ("", "")


def test_arrays_and_channels_of_other_names_are_told(tmp_path):
    np.savez(tmp_path / "depth.npz", near=np.ones((H, W)), far=np.ones((H, W)))
    with pytest.raises(SequenceError, match="no array 'depth' but near, far"):
        c3vd.read_depth_mm(tmp_path / "depth.npz")
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channels = {"mist.A": some_depth(), "mist.B": some_depth()}
    OpenEXR.File(header, channels).write(str(tmp_path / "depth.exr"))
    with pytest.raises(SequenceError, match=r"no channel Z but mist\.A, mist\.B"):
        c3vd.read_depth_mm(tmp_path / "depth.exr")


def test_what_holds_no_numbers_is_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.full((H, W), "x"))
    np.save(tmp_path / "b.npy", np.ones((H, W, 2)))
    for name, says in (("a.npy", "no depth"), ("b.npy", "shape")):
        with pytest.raises(SequenceError, match=says):
            c3vd.read_depth_mm(tmp_path / name)


@pytest.mark.parametrize("layout", ["c3vd", "c3vd2"])
def test_a_dataset_with_no_other_depth_is_read_back(tmp_path, layout):
    twin = tube_twin.fitted(tube_twin.seen(tube_twin.surface()))
    pose = [tube_twin.pose(0.5)]
    options = {"labels": "rgb,depth_exr", "layout": layout}
    endotwin.synthesize(twin, pose, tmp_path / "dataset", **options)
    found = open_sequence(tmp_path / "dataset").depth_mm(0)
    np.testing.assert_allclose(found, endotwin.Renderer(twin).view(pose[0]).depth_mm, rtol=1e-6)

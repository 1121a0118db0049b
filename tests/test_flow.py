"""Flow without limit beside C3VD's code, and a word on what that code loses."""

import io
import json

import cv2
import exr_file
import numpy as np
import pytest
import tube_twin

import endotwin

FLOWS = "rgb,flow,flow_exr,flow_npz,flow_forward,flow_forward_exr,flow_forward_npz"


@pytest.fixture(scope="module")
def twin() -> endotwin.Twin:
    return tube_twin.fitted(tube_twin.seen(tube_twin.surface()))


def poses(turn_deg: float) -> np.ndarray:
    """Two poses, the second turned sideways by so much."""
    turned = tube_twin.pose(0.5)
    turned[:3, :3] = turned[:3, :3] @ cv2.Rodrigues(np.radians([0, turn_deg, 0]))[0]
    return np.stack([tube_twin.pose(0.5), turned])


def coded(path) -> np.ndarray:
    raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1].astype(np.float64)
    flow = raw[..., :2] / 65535 * 40 - 20
    flow[(raw[..., :2] == 0).all(axis=-1)] = np.nan
    return flow


@pytest.mark.parametrize(("way", "frame"), [("flow", 1), ("flow_forward", 0)])
def test_it_is_the_same_in_every_container_and_beyond_the_code_in_floats_alone(twin, tmp_path, way, frame):
    endotwin.synthesize(twin, poses(25), tmp_path / "dataset", labels=FLOWS)
    stem = tmp_path / "dataset" / f"{frame:04d}_{way}"
    _, channels = exr_file.read(stem.with_name(f"{stem.name}_exr.exr").read_bytes())
    in_exr = np.stack([channels["X"], channels["Y"]], axis=-1)
    in_npz = np.load(stem.with_name(f"{stem.name}_npz.npz"))["flow"]
    np.testing.assert_array_equal(in_exr, in_npz)
    in_code = coded(stem.with_suffix(".tiff"))
    both = np.isfinite(in_code) & np.isfinite(in_npz)
    assert in_npz.dtype == np.float32 and (np.abs(in_npz[np.isfinite(in_npz)]) > 20).any()
    assert (np.abs(in_code[both]) <= 20).all()
    np.testing.assert_allclose(in_code[both], in_npz[both], atol=1e-3)


def test_the_first_frame_has_no_flow_to_the_one_before(twin, tmp_path):
    endotwin.synthesize(twin, poses(1), tmp_path / "dataset", labels="flow_npz")
    assert np.isnan(np.load(tmp_path / "dataset" / "0000_flow_npz.npz")["flow"]).all()
    assert (tmp_path / "dataset" / "0001_flow_hidden.png").exists()


def test_the_share_that_the_code_loses_is_told_once(twin, tmp_path, caplog):
    endotwin.synthesize(twin, poses(25), tmp_path / "wide", labels=FLOWS)
    found = np.load(tmp_path / "wide" / "0001_flow_npz.npz")["flow"]
    flows = np.isfinite(found).all(axis=-1)
    lost = (np.abs(found[flows]) > 20).any(axis=-1).mean()
    (said,) = [record.getMessage() for record in caplog.records if " of the flow is " in record.getMessage()]
    assert said.startswith(f"{100 * lost:.1f} % of the flow is beyond the ±20 px") and "flow_exr" in said
    caplog.clear()
    endotwin.synthesize(twin, poses(1), tmp_path / "narrow", labels="rgb,flow")
    endotwin.synthesize(twin, poses(25), tmp_path / "floats", labels="rgb,flow_exr")
    assert not caplog.records


def test_npz_files_do_not_tell_when_they_were_written(twin, tmp_path):
    for name in ("one", "two"):
        endotwin.synthesize(twin, poses(3), tmp_path / name, labels="flow_npz")
    one, two = ((tmp_path / name / "0001_flow_npz.npz").read_bytes() for name in ("one", "two"))
    assert one == two and np.load(io.BytesIO(one))["flow"].shape == (72, 96, 2)


def test_a_transforms_file_names_its_masks_and_its_reader_heeds_them(twin, tmp_path):
    options = {"labels": "rgb,depth,mask", "layout": "transforms"}
    summary = endotwin.synthesize(twin, poses(3), tmp_path / "dataset", **options)
    assert "nerfstudio needs --depth-unit-scale-factor 2e-06" in str(summary)
    file = tmp_path / "dataset" / "transforms.json"
    (mask, *_) = (frame["mask_path"] for frame in json.loads(file.read_text())["frames"])
    before = endotwin.open_sequence(tmp_path / "dataset").depth_mm(0)
    assert np.isfinite(before[:, :10]).any()
    picture = cv2.imread(str(tmp_path / "dataset" / mask), cv2.IMREAD_UNCHANGED)
    picture[:, :10] = 0
    cv2.imwrite(str(tmp_path / "dataset" / mask), picture)
    after = endotwin.open_sequence(tmp_path / "dataset").depth_mm(0)
    assert np.isnan(after[:, :10]).all()
    np.testing.assert_array_equal(after[:, 10:], before[:, 10:])
    (tmp_path / "dataset" / mask).unlink()
    with pytest.raises(endotwin.EndotwinError, match=r"named in transforms\.json, does not exist"):
        endotwin.open_sequence(tmp_path / "dataset")

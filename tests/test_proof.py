"""The proof of a dataset's labels: all that synth writes passes it; what is wrong in one file does not."""

import json
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import tube_twin
from command_line import invoke

from endotwin.effects.tone import Tone
from endotwin.errors import SequenceError
from endotwin.sequence.images import read_color
from endotwin.synth import LAYOUTS, Trajectory, parse_labels, prove, synthesize, with_fluids, with_polyps
from endotwin.synth.encodings import ENCODINGS
from endotwin.synth.proof import CLAIMS, Written
from endotwin.twin import Twin

FRAMES = 3
CAMERA = tube_twin.CAMERA.scaled(2)


def poses() -> np.ndarray:
    """Three poses between folds, near enough for flow of some pixels."""
    found = np.stack([tube_twin.pose(s) for s in (0.5, 0.52, 0.545)])
    found[1, :3, 3] += (0.4, -0.3, 0)
    return found


def trajectory() -> Trajectory:
    return Trajectory(poses(), np.arange(FRAMES) / 30, "three poses")


@cache
def twin() -> Twin:
    """A tube with folds that hide each other, a polyp and a film of blood."""
    tube = tube_twin.fitted(tube_twin.seen(tube_twin.surface(fold_mm=3.0)))
    grown = with_polyps(tube, "Is:size=4", 0, trajectory())[0]
    return with_fluids(grown, "blood:size=14,thickness=0.05", 0, trajectory())[0]


def rendered(folder: Path, **options) -> Path:
    """A dataset of it."""
    options = {"labels": parse_labels("all", polyps=True, fluids=True), "camera": CAMERA} | options
    synthesize(twin(), trajectory(), folder, **options)
    return folder


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    return rendered(tmp_path_factory.mktemp("proof") / "dataset")


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_claim_holds_of_every_layout(layout, tmp_path):
    proof = prove(rendered(tmp_path / "d", layout=layout))
    assert [row.claim for row in proof.rows] == list(CLAIMS)
    assert proof.holds, proof.broken
    assert all(row.pixels > 100 for row in proof.rows)


@pytest.mark.parametrize("label", parse_labels("all", polyps=True, fluids=True))
def test_a_label_alone_proves_what_it_can_and_breaks_nothing(label, tmp_path):
    proof = prove(rendered(tmp_path / "d", labels=(label,), camera=tube_twin.CAMERA))
    assert proof.holds, proof.broken


def test_the_response_of_a_toned_twin_is_proved_too(tmp_path):
    toned = replace(twin(), effects=twin().effects.including(Tone(0.4)))
    synthesize(toned, trajectory(), tmp_path / "d", labels=("rgb", "rgb_linear"))
    (row,) = (row for row in prove(tmp_path / "d").rows if row.claim == "response")
    assert row.holds and row.pixels > 1000
    document = json.loads((tmp_path / "d" / "dataset.json").read_text(encoding="utf-8"))
    document["twin"]["effects"]["tone"]["contrast"] = 0.0
    (tmp_path / "d" / "dataset.json").write_text(json.dumps(document), encoding="utf-8")
    assert not prove(tmp_path / "d").holds


def test_frames_far_apart_prove_their_labels(tmp_path):
    apart = Trajectory(np.stack([tube_twin.pose(s) for s in (0.35, 0.6)]), np.arange(2) / 30, "two poses")
    synthesize(twin(), apart, tmp_path / "d", labels=parse_labels("all", polyps=True, fluids=True))
    proof = prove(tmp_path / "d")
    assert proof.holds, proof.broken


def test_files_are_read_as_the_encodings_wrote_them(dataset):
    written = Written.open(dataset)
    rgb = read_color(dataset / "0001_color.png")
    np.testing.assert_array_equal(np.rint(255 * written.image(1, "rgb")), rgb)
    for name in written.images:
        image, encoding = written.image(1, name), ENCODINGS[name]
        again = encoding.decode(encoding.encode(image))
        np.testing.assert_allclose(again, image, atol=1e-6 + encoding.step / 1e3, err_msg=name)


def swapped(flow: np.ndarray) -> np.ndarray:
    return flow[..., ::-1].copy()


def in_world(normals: np.ndarray) -> np.ndarray:
    return normals @ poses()[1][:3, :3].T


WRONG = {
    "depth is along the ray": (
        "depth_exr",
        lambda z: z / CAMERA.pixel_directions[..., 2],
        "flow",
    ),
    "depth is off by 1 %": ("depth", lambda z: z * 1.01, "codes"),
    "flow has its axes swapped": ("flow_npz", swapped, "flow"),
    "flow is forward, not back": ("flow_exr", np.negative, "codes"),
    "forward flow is a pixel off": ("flow_forward_npz", lambda flow: flow + 1, "cycle"),
    "normals are in the world's axes": ("normals", in_world, "normals"),
    "normals look away": ("normals", np.negative, "normals"),
    "nothing is hidden": ("flow_hidden", lambda hidden: np.where(hidden == 255, 0, hidden), "hidden"),
    "all is hidden": ("flow_hidden", lambda hidden: np.where(hidden == 0, 255, hidden), "hidden"),
    "nothing is occluded": ("occlusion", np.zeros_like, "occlusion"),
    "the mask is a column off": ("mask", lambda mask: np.roll(mask, 1, axis=1), "places"),
    "triangles are counted from 1": ("triangles", lambda ids: ids + (ids >= 0), "triangles"),
    "base colour is mirrored": ("albedo", lambda albedo: albedo[:, ::-1].copy(), "materials"),
    "rgb has other channels first": ("rgb", swapped, "split"),
    "linear is not": ("rgb_linear", np.sqrt, "codes"),
    "a polyp has another number": ("polyp", lambda ids: 2 * ids, "polyps"),
    "polyps are a pixel lower": ("polyp", lambda ids: np.roll(ids, 1, axis=0), "polyps"),
    "a fluid has another number": ("fluid", lambda ids: 2 * ids, "fluids"),
    "highlights are everywhere": ("highlights", lambda mask: np.full_like(mask, 255), "places"),
}


@pytest.mark.parametrize("fault", WRONG)
def test_what_is_wrong_in_one_image_breaks_a_claim(fault, dataset, tmp_path):
    name, do, claim = WRONG[fault]
    shutil.copytree(dataset, tmp_path / "d")
    written, encoding = Written.open(tmp_path / "d"), ENCODINGS[name]
    file = tmp_path / "d" / written.layout.file(written, 1, name)
    file.write_bytes(encoding.encode(do(written.image(1, name)).astype(written.image(1, name).dtype)))
    proof = prove(tmp_path / "d")
    assert claim in [row.claim for row in proof.rows if not row.holds]


def test_poses_the_wrong_way_round_break_flow_and_depth(dataset, tmp_path):
    shutil.copytree(dataset, tmp_path / "d")
    records = [json.loads(line) for line in (dataset / "frames.jsonl").read_text().splitlines()]
    for record in records:
        record["T_world_camera"] = np.linalg.inv(record["T_world_camera"]).tolist()
    (tmp_path / "d" / "frames.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    broken = {row.claim for row in prove(tmp_path / "d").rows if not row.holds}
    assert {"flow", "warp"} <= broken


def test_a_file_that_is_gone_is_named(dataset, tmp_path):
    shutil.copytree(dataset, tmp_path / "d")
    (tmp_path / "d" / "0001_normals.tiff").unlink()
    with pytest.raises(SequenceError, match=r"0001_normals\.tiff is missing"):
        prove(tmp_path / "d")


def test_the_datasheet_has_the_table(dataset):
    page = (dataset / "datasheet.html").read_text()
    assert "The labels agree" in page
    assert all(claim.says.split(",")[0].replace("'", "&#x27;") in page for claim in CLAIMS.values())


def test_the_command_prints_the_table_and_its_exit_code_tells(dataset, tmp_path, capsys):
    assert invoke("check", dataset, "--labels") == 0
    out = capsys.readouterr().out
    assert "The labels agree" in out and "0.05 px" in out
    shutil.copytree(dataset, tmp_path / "d")
    cv2.imwrite(str(tmp_path / "d" / "0000_mask.png"), np.zeros((CAMERA.height, CAMERA.width), np.uint8))
    assert invoke("check", tmp_path / "d", "--labels", "--json") == 1
    found = json.loads(capsys.readouterr().out)
    assert not found["holds"] and [c["claim"] for c in found["claims"] if not c["holds"]] == ["places"]


def test_what_is_no_dataset_is_refused_in_one_line(tmp_path, capsys):
    assert invoke("check", tmp_path, "--labels") == 2
    error = capsys.readouterr().err
    assert error.startswith("error:") and "dataset.json" in error and error.count("\n") == 1

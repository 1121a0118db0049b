"""A twin on disk is the twin in memory; what is no twin is said to be none."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
import tube_twin
from scenes import omni

from endotwin.effects import Effects
from endotwin.effects.gain import Gain
from endotwin.effects.offset import Offset
from endotwin.effects.shadows import Shadows
from endotwin.effects.vignetting import Vignetting
from endotwin.errors import OutputError, TwinError
from endotwin.twin import Source, Twin
from endotwin.twin.twin import VERSION


@pytest.fixture(scope="module")
def twin() -> Twin:
    made = tube_twin.fitted(tube_twin.seen(tube_twin.surface()))
    return replace(made, materials=replace(made.materials, f0=0.0517, diffuse="lambert"), camera=omni())


def assert_same(one: Twin, other: Twin) -> None:
    for mine, theirs in ((one.surface, other.surface), (one.materials, other.materials)):
        for name, value in vars(mine).items() if mine else ():
            again = getattr(theirs, name)
            if isinstance(value, np.ndarray):
                assert again.dtype == value.dtype and again.tobytes() == value.tobytes(), name
            else:
                assert again == value, name
    assert (other.materials is None) == (one.materials is None)
    assert other.camera == one.camera and other.source == one.source
    assert (other.light, other.response, other.record) == (one.light, one.response, one.record)


def test_a_saved_twin_loads_bit_for_bit(twin, tmp_path):
    twin = twin.with_record(
        fit={"seconds": 1.25, "stages": {"light": 0.1}}, eval={"psnr": 38.5, "ssim": 0.97}
    )
    twin.save(tmp_path / "twin")
    assert_same(twin, Twin.load(tmp_path / "twin"))
    assert [p.name for p in tmp_path.iterdir()] == ["twin"]


def test_an_unfitted_twin_loads_unfitted_over_a_fitted_one(twin, tmp_path):
    twin.save(tmp_path / "twin")
    unfitted = tube_twin.unfitted(twin)
    unfitted.save(tmp_path / "twin", overwrite=True)
    loaded = Twin.load(tmp_path / "twin")
    assert_same(unfitted, loaded)
    assert not loaded.fitted and "not fitted" in repr(loaded)
    assert not (tmp_path / "twin" / "materials.safetensors").exists()


def test_a_twin_that_exists_is_refused_untouched(twin, tmp_path):
    twin.save(tmp_path / "twin")
    with pytest.raises(OutputError, match="--overwrite"):
        tube_twin.unfitted(twin).save(tmp_path / "twin")
    assert Twin.load(tmp_path / "twin").fitted


def test_print_tells_light_response_and_scores(twin):
    text = repr(twin.with_record(eval={"psnr": 38.512, "ssim": 0.9712}))
    for part in ("26,400 vertices", "omni", "n 2.000", "q 2.000", "0.4545", "38.51 dB", "0.9712"):
        assert part in text


def test_print_tells_the_effects_and_where_the_guides_are(twin):
    effects = [
        Offset(((3.24, 0.55, 0.0), (-2.8, 2.0, 0.0))),
        Shadows(),
        Gain((1, 2), (-0.1, 0.1)),
        Vignetting(-0.3, 0.05),
    ]
    assert "effects: none" in repr(replace(twin, effects=Effects()))
    assert (
        "effects: offset (guides at (3.24, 0.55, 0.00), (-2.80, 2.00, 0.00) mm), shadows, "
        "gain (×0.90 to ×1.11), vignetting (k2 -0.3, k4 0.05)"
    ) in repr(replace(twin, effects=Effects(effects)))


def test_a_twin_of_a_newer_version_is_refused(twin, tmp_path):
    twin.save(tmp_path / "twin")
    file = tmp_path / "twin" / "twin.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "version": VERSION + 1}))
    with pytest.raises(TwinError, match=f"version {VERSION + 1}, newer.*update endotwin"):
        Twin.load(tmp_path / "twin")


def test_what_is_no_twin_is_said_to_be_none(tmp_path):
    for path in (tmp_path, tmp_path / "missing"):
        with pytest.raises(TwinError, match=r"is not a twin.*endotwin fuse"):
            Twin.load(path)


def test_a_file_of_a_twin_is_not_the_twin(twin, tmp_path):
    twin.save(tmp_path / "twin")
    with pytest.raises(TwinError, match="is a file; give the folder"):
        Twin.load(tmp_path / "twin" / "twin.json")


def test_a_twin_whose_scores_could_not_be_measured_prints_none(twin):
    assert "held out" not in repr(twin.with_record(eval={"psnr": None, "ssim": None}))


@pytest.mark.parametrize("text", ("", "{", "[]", "{}", "null", '"twin"'))
def test_an_unreadable_document_names_its_file(twin, tmp_path, text):
    twin.save(tmp_path / "twin")
    (tmp_path / "twin" / "twin.json").write_text(text)
    with pytest.raises(TwinError, match=r"twin\.json cannot be read"):
        Twin.load(tmp_path / "twin")


@pytest.mark.parametrize("name", ("surface.safetensors", "materials.safetensors"))
@pytest.mark.parametrize("kept", (None, 0, 100))
def test_a_missing_or_truncated_array_file_is_a_damaged_twin(twin, tmp_path, name, kept):
    twin.save(tmp_path / "twin")
    file = tmp_path / "twin" / name
    data = file.read_bytes()
    file.unlink()
    if kept is not None:
        file.write_bytes(data[:kept])
    with pytest.raises(TwinError, match="damaged twin"):
        Twin.load(tmp_path / "twin")


@pytest.mark.parametrize("key", ("camera", "source", "materials", "light", "record"))
def test_a_document_that_lacks_a_part_is_a_damaged_twin(twin, tmp_path, key):
    twin.save(tmp_path / "twin")
    file = tmp_path / "twin" / "twin.json"
    document = json.loads(file.read_text())
    del document[key]
    file.write_text(json.dumps(document))
    with pytest.raises(TwinError, match=f"damaged twin.*{key}"):
        Twin.load(tmp_path / "twin")


@pytest.mark.parametrize("count", (2, 8, 9, 24, 64))
def test_every_eighth_frame_from_the_first_is_held_out_and_the_others_are_fitted(count):
    source = Source("sequence", "c3vd")
    assert source.heldout(count) == [index for index in range(count) if index % 8 == 0]
    assert sorted(source.heldout(count) + source.training(count)) == list(range(count))
    assert source.training(count)


def test_a_single_frame_is_fitted():
    assert Source("sequence", "c3vd").training(1) == [0]
    assert Source("sequence", "c3vd").heldout(1) == []


def test_the_source_survives_a_round_trip_through_a_dictionary():
    source = Source("sequence", "tum", 0.5, "heldout", 4)
    assert Source(**json.loads(json.dumps(asdict(source)))) == source

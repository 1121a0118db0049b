"""A twin on disk is the twin in memory; what is no twin is said to be none."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
import tube_twin
from faults import full_disk, killed_at_every_operation
from safetensors.numpy import save_file
from scenes import omni

from endotwin.effects import Decision, Effects
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
    assert not list((tmp_path / "twin").glob("materials*"))


def test_what_needs_materials_says_that_a_twin_has_none_yet(twin, tmp_path):
    twin.require_fitted()
    unfitted = tube_twin.unfitted(twin)
    for need in (unfitted.require_fitted, lambda: unfitted.export(tmp_path / "twin.ply")):
        with pytest.raises(TwinError, match="no materials yet; run 'endotwin fit'"):
            need()
    assert not list(tmp_path.iterdir())


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


def test_scores_replace_one_small_file_and_a_fit_leaves_the_surface(twin, tmp_path):
    tube_twin.unfitted(twin).save(tmp_path / "twin")
    (surface,) = files = list((tmp_path / "twin").glob("surface-*"))
    written = surface.stat().st_ino
    twin.save(tmp_path / "twin", overwrite=True)
    files = {file.name: file.stat().st_ino for file in (tmp_path / "twin").iterdir()}
    assert files[surface.name] == written and len(files) == 3
    twin.with_record(eval={"psnr": 38.5}).save(tmp_path / "twin", overwrite=True)
    after = {file.name: file.stat().st_ino for file in (tmp_path / "twin").iterdir()}
    assert files.keys() == after.keys()
    assert {name for name in files if files[name] != after[name]} == {"twin.json"}
    assert (tmp_path / "twin" / "twin.json").stat().st_size < 10_000


def write_version_1(twin: Twin, folder) -> None:
    """The twin as version 1 had it: arrays under fixed names, decisions in a file of their own."""
    folder.mkdir()
    (folder / "surface.safetensors").write_bytes(twin.surface.to_bytes())
    save_file(twin.materials.per_vertex, folder / "materials.safetensors")
    decisions = {name: asdict(decision) for name, decision in twin.decisions.items()}
    (folder / "effects.json").write_text(json.dumps({"effects": decisions}))
    document = {
        "version": 1,
        "camera": twin.camera.to_dict(),
        "source": asdict(twin.source),
        "materials": {"f0": twin.materials.f0, "diffuse": twin.materials.diffuse},
        "light": asdict(twin.light),
        "response": asdict(twin.response),
        "effects": twin.effects.to_dict(),
        "record": twin.record,
    }
    (folder / "twin.json").write_text(json.dumps(document))


def test_a_twin_of_version_1_loads_and_the_next_that_is_saved_there_takes_its_place(twin, tmp_path):
    twin = replace(twin, decisions={"gain": Decision("off", "the gain is kept")})
    write_version_1(twin, tmp_path / "twin")
    loaded = Twin.load(tmp_path / "twin")
    assert_same(twin, loaded)
    assert loaded.decisions == twin.decisions
    loaded.save(tmp_path / "twin", overwrite=True)
    assert_same(twin, Twin.load(tmp_path / "twin"))
    assert Twin.load(tmp_path / "twin").decisions == twin.decisions
    names = {file.name.split("-")[0] for file in (tmp_path / "twin").iterdir()}
    assert names == {"twin.json", "surface", "materials"}


def fitted_again(twin: Twin) -> Twin:
    """The twin with other materials and another light."""
    materials = replace(twin.materials, roughness=1 - twin.materials.roughness)
    return replace(twin, materials=materials, light=replace(twin.light, L0=9.0))


@pytest.mark.parametrize("before", [lambda twin, path: twin.save(path), write_version_1])
@pytest.mark.parametrize("change", [fitted_again, lambda twin: twin.with_record(eval={"psnr": 38.5})])
def test_a_twin_is_old_or_new_wherever_its_replacement_is_killed(tmp_path, before, change):
    old = tube_twin.fitted(tube_twin.surface())
    new, path, found = change(old), tmp_path / "twin", []
    before(old, path)

    def look() -> None:
        loaded = Twin.load(path)
        found.append((loaded.light, loaded.record) != (old.light, old.record))
        assert_same(new if found[-1] else loaded, loaded)
        assert_same(loaded if found[-1] else old, loaded)
        old.save(path, overwrite=True)
        assert len(list(path.iterdir())) == 3 and list(tmp_path.iterdir()) == [path]

    assert killed_at_every_operation(lambda: new.save(path, overwrite=True), look) >= 5
    assert found == sorted(found) and set(found) == {False, True}


def test_a_full_disk_leaves_the_twin_as_it_was(twin, tmp_path):
    twin.save(tmp_path / "twin")
    before = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    for after in range(5):
        told = pytest.raises(OutputError, match="twin cannot be written: the disk is full")
        with told, full_disk(tmp_path, after):
            fitted_again(twin).save(tmp_path / "twin", overwrite=True)
        assert {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()} == before


@pytest.mark.parametrize("name", ("surface", "materials"))
@pytest.mark.parametrize("place", (0.1, 0.5, 0.9))
def test_a_flipped_bit_in_an_array_file_is_told(twin, tmp_path, name, place):
    twin.save(tmp_path / "twin")
    (file,) = (tmp_path / "twin").glob(f"{name}-*")
    content = bytearray(file.read_bytes())
    content[int(place * len(content))] ^= 4
    file.write_bytes(content)
    with pytest.raises(TwinError, match=f"damaged twin \\({file.name} does not match its checksum\\)"):
        Twin.load(tmp_path / "twin")


def test_a_changed_number_in_the_document_is_told_and_the_sequence_may_move(twin, tmp_path):
    twin.save(tmp_path / "twin")
    file = tmp_path / "twin" / "twin.json"
    document = json.loads(file.read_text())
    file.write_text(json.dumps({**document, "source": {**document["source"], "path": "/elsewhere"}}))
    assert Twin.load(tmp_path / "twin").source.path == "/elsewhere"
    document["light"]["L0"] += 1e-9
    file.write_text(json.dumps(document))
    with pytest.raises(TwinError, match=r"damaged twin \(twin.json does not match its checksum\)"):
        Twin.load(tmp_path / "twin")


@pytest.mark.parametrize("name", ("surface", "materials"))
@pytest.mark.parametrize("kept", (None, 0, 100))
def test_a_missing_or_truncated_array_file_is_a_damaged_twin(twin, tmp_path, name, kept):
    twin.save(tmp_path / "twin")
    (file,) = (tmp_path / "twin").glob(f"{name}-*")
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


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda surface: replace(surface, triangles=surface.triangles[:0]), "its surface is empty"),
        (
            lambda surface: replace(surface, vertices_mm=surface.vertices_mm * np.float32(1e30)),
            r"its surface is .*e\+31 mm large",
        ),
    ],
)
def test_a_mesh_that_is_none_is_told_and_not_blamed_on_the_sequence(twin, tmp_path, spoil, says):
    replace(twin, surface=spoil(twin.surface)).save(tmp_path / "twin")
    with pytest.raises(TwinError, match=says):
        Twin.load(tmp_path / "twin")

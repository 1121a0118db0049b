"""Fluids on a tube whose wall is known: their optics, the mesh that carries them, their label."""

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
import tube_twin
from hypothesis import given
from hypothesis import strategies as st

import endotwin
from endotwin.anatomy.optics import MUCUS, STOOL, WHOLE_BLOOD, blood, layered
from endotwin.errors import OptionError, TwinError
from endotwin.render import Renderer
from endotwin.surface.casting import Caster
from endotwin.surface.vectors import unit
from endotwin.synth import Trajectory, parse_labels, prove, with_fluids, with_polyps
from endotwin.synth.fluids import FLUIDS
from endotwin.synth.job import Job, fingerprint
from endotwin.synth.labels import Labeller
from endotwin.synth.motion.crossing import crossings
from endotwin.synth.run.dataset import make_job
from endotwin.synth.variation import Variation
from endotwin.twin import Twin
from endotwin.twin.fluids import covered

SEVERAL = ["blood:size=8", "mucus:size=8", "stool:size=6,count=2"]
reflectances = st.floats(0, 1)
lengths_mm = st.floats(0, 20)


@pytest.fixture(scope="module")
def bare() -> Twin:
    return tube_twin.fitted(tube_twin.seen(tube_twin.surface()))


@pytest.fixture(scope="module")
def folded() -> Twin:
    return tube_twin.fitted(tube_twin.seen(tube_twin.surface(fold_mm=4)))


def on_the_wall(s: float) -> str:
    """A place of the tube's wall at angle ``s`` of its axis, beside it in y."""
    x, y, z = tube_twin.axis(np.array(s))[0] + [0, tube_twin.RADIUS_MM, 0]
    return f"x={x:.4f},y={y:.4f},z={z:.4f}"


def poses() -> np.ndarray:
    return np.stack([tube_twin.pose(s) for s in (0.3, 0.31, 0.32)])


def trajectory() -> Trajectory:
    return Trajectory(poses(), np.arange(3) / 10, "three poses")


def job_of(twin: Twin, labels: str) -> Job:
    names = parse_labels(labels, polyps=True, fluids=True)
    return make_job(twin, trajectory(), 0, names, "c3vd", twin.camera.scaled(3), Variation())


@pytest.fixture(scope="module")
def several(bare) -> Twin:
    return with_fluids(bare, SEVERAL, 1, trajectory())[0]


@pytest.fixture(scope="module", params=FLUIDS)
def one(request, bare) -> tuple[str, Twin]:
    """A twin with one patch in the middle of the tube."""
    return request.param, with_fluids(bare, f"{request.param}:size=8,{on_the_wall(0.8)}", 3)[0]


@given(reflectances, reflectances, lengths_mm)
def test_without_scattering_a_layer_absorbs_by_beer_and_lambert_twice_through(substrate, absorption, mm):
    found = layered(*(np.array(x) for x in (absorption, 0.0, substrate, mm)))
    assert found == pytest.approx(substrate * np.exp(-2 * absorption * mm), abs=1e-6)


@given(st.floats(1e-3, 50), st.floats(1e-3, 50), reflectances, st.floats(1e-3, 3))
def test_a_layer_reflects_as_kubelka_wrote_it(absorption, scattering, substrate, mm):
    """Kubelka 1948, eq. 29, with hyperbolic cotangents as they stand there."""
    a = 1 + absorption / scattering
    b = np.sqrt(a * a - 1)
    coth = 1 / np.tanh(b * scattering * mm)
    expected = (1 - substrate * (a - b * coth)) / (a - substrate + b * coth)
    found = layered(*(np.array(x) for x in (absorption, scattering, substrate, mm)))
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("optics", [blood(WHOLE_BLOOD), blood(20.0), MUCUS, STOOL])
def test_no_layer_is_the_tissue_and_a_thick_one_hides_it(optics):
    generator = np.random.default_rng(0)
    tissue = generator.uniform(0, 1, (50, 3))
    np.testing.assert_allclose(optics.over(tissue, np.zeros(50)), tissue, atol=1e-12)
    thick = optics.over(tissue, np.full(50, 1e3))
    np.testing.assert_allclose(thick, np.broadcast_to(thick[0], thick.shape), atol=1e-6)
    a = 1 + np.array(optics.absorption) / optics.scattering
    np.testing.assert_allclose(thick[0], a - np.sqrt(a * a - 1), atol=1e-6)
    between = optics.over(tissue, generator.uniform(0, 5, 50))
    assert (between >= np.minimum(tissue, thick) - 1e-9).all()
    assert (between <= np.maximum(tissue, thick) + 1e-9).all()


def test_blood_absorbs_as_haemoglobin_does():
    """2 μa = 2 ln10 ε c: of whole blood at 540 nm, ε = 53236 (Prahl), 28 per mm each way; red passes."""
    red, green, blue = blood(WHOLE_BLOOD).absorption
    assert 2 * np.log(10) / 10 * 24202 * 150 / 64500 < green < 2 * np.log(10) / 10 * 53236 * 150 / 64500
    assert blue > green > 20 * red
    np.testing.assert_allclose(blood(75.0).absorption, np.array([red, green, blue]) / 2)
    black = replace(blood(WHOLE_BLOOD), scattering=(0.0,) * 3).over(np.ones((1, 3)), np.array([50.0]))
    assert black.max() < 1e-6


def test_stool_is_brown_mucus_pale_and_blood_red():
    tissue, thick = np.array([[0.6, 0.35, 0.3]]), np.array([1.0])
    r, g, b = FLUIDS["stool"].optics.over(tissue, thick)[0]
    assert r > g > 2 * b
    r, g, b = FLUIDS["blood"].optics.over(tissue, thick)[0]
    assert r > 10 * max(g, b)
    pale = FLUIDS["mucus"].optics.over(tissue, thick)[0]
    assert (pale > tissue[0]).all() and pale[0] > pale[1] > pale[2]


def test_the_label_is_where_the_materials_differ(one, bare):
    _, twin = one
    before, after = (Labeller(job_of(each, "albedo,roughness")).frame(0) for each in (bare, twin))
    label = Labeller(job_of(twin, "fluid")).frame(0)["fluid"]
    assert label.dtype == np.uint8
    assert set(np.unique(label)) == {0, 1}
    off = np.abs(after["albedo"] - before["albedo"]).max(axis=2)
    assert off[label == 0].max() < 1e-5
    assert (off[label == 1] > 1e-3).mean() > 0.9
    assert np.abs(after["roughness"] - before["roughness"])[label == 0].max() < 1e-5


def test_fluid_lies_as_thick_above_the_wall_as_the_table_says(one, bare):
    """A ray along the tube's radius meets it nearer by so much, and nothing elsewhere."""
    kind, twin = one
    (fluid,) = twin.fluids
    assert 0.6 * (found := FLUIDS[kind].usual_mm) < fluid.thickness_mm <= found
    number = covered([fluid.triangles], len(twin.surface.triangles))
    own = np.unique(twin.surface.triangles[number == 1])
    points = twin.surface.vertices_mm[own] + twin.surface.origin_mm
    _, inward = tube_twin.to_axis(points)
    risen_mm = tube_twin.RADIUS_MM - np.linalg.norm(inward, axis=1)
    assert risen_mm.max() == pytest.approx(fluid.thickness_mm, rel=0.1, abs=0.02)
    assert risen_mm.min() > -1e-3
    highest = points[risen_mm.argmax()] - twin.surface.origin_mm
    towards = -unit(inward[risen_mm.argmax()])
    start = (highest - 4 * towards).astype(np.float32)[None]
    depths = [
        Caster(each.surface).cast_rays(start, towards.astype(np.float32)[None])[2][0] for each in (bare, twin)
    ]
    assert depths[0] - depths[1] == pytest.approx(risen_mm.max(), abs=0.03)


def test_depth_is_that_of_before_where_no_fluid_is(one, bare):
    _, twin = one
    before, after = (Labeller(job_of(each, "depth_exr")).frame(0)["depth_exr"] for each in (bare, twin))
    label = Labeller(job_of(twin, "fluid")).frame(0)["fluid"]
    np.testing.assert_allclose(after[label == 0], before[label == 0], rtol=1e-5)
    assert (before - after)[label == 1].min() > -1e-3


def test_the_mesh_stays_a_tube_without_seams(one, bare):
    _, twin = one
    before, after = (
        trimesh.Trimesh(each.surface.vertices_mm, each.surface.triangles, process=False)
        for each in (bare, twin)
    )
    assert after.is_winding_consistent
    assert after.euler_number == before.euler_number
    assert after.area_faces.min() > 0
    own = covered([twin.fluids[0].triangles], len(twin.surface.triangles)) > 0
    assert own[crossings(twin.surface)].sum() < 0.002 * own.sum()


def test_the_wall_elsewhere_is_unchanged_bit_for_bit(one, bare):
    _, twin = one
    count = len(bare.surface.vertices_mm)
    place = np.array(twin.fluids[0].place_mm) - bare.surface.origin_mm
    away = np.linalg.norm(bare.surface.vertices_mm - place, axis=1) > 6
    for name in ("vertices_mm", "normals", "seen_by", "nearest_mm", "filled"):
        np.testing.assert_array_equal(
            getattr(twin.surface, name)[:count][away], getattr(bare.surface, name)[away]
        )
    for name, before in bare.materials.per_vertex.items():
        np.testing.assert_array_equal(twin.materials.per_vertex[name][:count][away], before[away])


def test_a_pool_is_level_and_no_deeper_than_its_hollow(folded):
    """Between two folds at the bottom, gravity along y."""
    spec = "blood:size=10,pool=true,gy=1"
    twin, _ = with_fluids(folded, spec, 0)
    (fluid,) = twin.fluids
    assert fluid.pool and 0.3 < fluid.thickness_mm <= 2.5 and fluid.size_mm < 11
    number = covered([fluid.triangles], len(twin.surface.triangles))
    inner = np.unique(twin.surface.triangles[number == 1])
    rim = np.unique(twin.surface.triangles[number == 0])
    surface_mm = twin.surface.vertices_mm[np.setdiff1d(inner, rim), 1]
    assert np.ptp(surface_mm) < 1e-4
    normals = twin.surface.normals[np.setdiff1d(inner, rim)]
    assert np.median(normals[:, 1]) < -0.999
    assert (twin.surface.vertices_mm[np.intersect1d(inner, rim), 1] < surface_mm.mean() + 2e-3).all()


def test_a_pool_runs_off_a_tube_that_holds_none(bare):
    with pytest.raises(OptionError, match="run off"):
        with_fluids(bare, f"blood:size=10,pool=true,gy=-1,{on_the_wall(0.8)}", 0)
    with pytest.raises(OptionError, match="no hollow of what is seen"):
        with_fluids(bare, "blood:size=10,pool=true,gz=1", 0, trajectory())


def test_a_seed_decides_shapes_and_places(bare, several):
    again, other = (with_fluids(bare, SEVERAL, seed, trajectory())[0] for seed in (1, 2))
    assert fingerprint(again) == fingerprint(several)
    assert len({fingerprint(twin) for twin in (bare, several, other)}) == 3


def test_the_table_counts_what_is_in_the_frames(several):
    assert [fluid.kind for fluid in several.fluids] == ["blood", "mucus", "stool", "stool"]
    job = job_of(several, "fluid,triangles")
    labeller = Labeller(job)
    numbers = covered((each.triangles for each in several.fluids), len(several.surface.triangles))
    shown = set()
    for k in range(3):
        images = labeller.frame(k)
        triangle = images["triangles"]
        np.testing.assert_array_equal(images["fluid"], np.where(triangle >= 0, numbers[triangle], 0))
        shown |= set(np.unique(images["fluid"]))
    assert shown == {0, 1, 2, 3, 4}
    assert [each["number"] for each in job.document["fluids"]] == [1, 2, 3, 4]


def test_radiance_scales_exactly_with_exposure(several):
    once, twice = (Renderer(several, exposure=each).view(poses()[0]).radiance for each in (1.0, 2.0))
    np.testing.assert_array_equal(twice, 2 * once)


def test_fluid_may_lie_on_a_polyp_whose_label_stays(bare):
    grown, _ = with_polyps(bare, f"Is:size=5,{on_the_wall(0.8)}", 3)
    top = on_the_wall(0.8).replace("y=12.0", "y=9.3")
    wet, _ = with_fluids(grown, f"blood:size=4,{top}", 3)
    before, after = (Labeller(job_of(each, "polyp")).frame(0)["polyp"] for each in (grown, wet))
    assert (before != after).mean() < 1e-3
    label = Labeller(job_of(wet, "fluid")).frame(0)["fluid"]
    assert ((after > 0) & (label > 0)).any()
    assert len(wet.fluids[0].triangles) >= 1
    with pytest.raises(OptionError, match="grow polyps on the one without"):
        with_polyps(wet, "Is:size=4", 0)


def test_a_twin_with_fluids_is_saved_and_takes_more(several, tmp_path):
    several.save(tmp_path / "twin")
    loaded = Twin.load(tmp_path / "twin")
    assert loaded.fluids == several.fluids
    assert fingerprint(loaded) == fingerprint(several)
    assert "blood over" in repr(loaded)
    more = endotwin.with_fluids(loaded, "mucus:size=4", seed=9)
    assert [fluid.kind for fluid in more.fluids] == ["blood", "mucus", "stool", "stool", "mucus"]
    damaged = replace(several, fluids=(replace(several.fluids[0], triangles=((10**8, 3),)),))
    damaged.save(tmp_path / "damaged")
    with pytest.raises(TwinError, match="fluid"):
        Twin.load(tmp_path / "damaged")
    for found in (endotwin.fit_twin, endotwin.align_twin):
        with pytest.raises(TwinError, match="take the one without them"):
            found(several)


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        ("paint", "no known kind; write blood or mucus or stool"),
        ("blood:size=1", "size lies between 2 and 60 mm"),
        ("blood:thickness=3", "thickness lies between 0.01 and 1 mm"),
        ("blood:count=0", "count"),
        ("blood:count=1000", "255 patches"),
        ("mucus:haemoglobin=20", "only blood has haemoglobin"),
        ("mucus:x=15,y=0,z=40", "mm from the surface"),
        ("stool:pool=maybe", "is true or false"),
        ("stool:colour=3", "'colour=3' is not understood"),
    ],
)
def test_what_cannot_lie_is_refused_in_a_sentence(bare, spec, said):
    with pytest.raises(OptionError, match=said) as refused:
        with_fluids(bare, spec, 0, trajectory())
    assert "\n" not in str(refused.value)


def test_one_fluid_does_not_lie_on_another_and_the_label_needs_one(bare):
    place = on_the_wall(0.8)
    with pytest.raises(OptionError, match="another fluid lies there"):
        with_fluids(bare, [f"blood:size=6,{place}", f"mucus:size=6,{place}"], 0)
    with pytest.raises(OptionError, match="--fluid"):
        make_job(bare, trajectory(), 0, ("fluid",), "c3vd", bare.camera, Variation())
    with pytest.raises(TwinError, match="fit"):
        with_fluids(tube_twin.unfitted(bare), "blood", 0)


def test_without_fluids_nothing_of_them_is_written(bare):
    job = make_job(bare, trajectory(), 0, parse_labels("all"), "c3vd", bare.camera, Variation())
    assert "fluid" not in job.labels and "fluids" not in job.document


@pytest.mark.slow
@pytest.mark.parametrize("motion", [(), ("peristalsis:amplitude=1,width=0.1", "breathing:amplitude=2")])
def test_a_dataset_with_fluids_is_proved(tmp_path, motion):
    path = np.stack([*poses(), *(tube_twin.pose(s) for s in (0.33, 0.34))])
    folded = tube_twin.fitted(tube_twin.seen(tube_twin.surface(fold_mm=3)))
    twin = replace(folded, camera=folded.camera.scaled(2))
    choices = {"fluids": SEVERAL, "motion": motion, "labels": "all", "seed": 1}
    endotwin.synthesize(twin, path, tmp_path / "d", **choices)
    proof = prove(tmp_path / "d")
    assert proof.holds, proof.broken
    (row,) = [row for row in proof.rows if row.claim == "fluids"]
    assert row.pixels > 1000
    document = json.loads((tmp_path / "d" / "dataset.json").read_text())
    assert [fluid["kind"] for fluid in document["fluids"]] == ["blood", "mucus", "stool", "stool"]
    assert "mucus, " in (tmp_path / "d" / "datasheet.html").read_text()

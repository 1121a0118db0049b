"""Polyps grown on a tube whose wall is known: their measures, the mesh that carries them, their labels."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
import tube_twin
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import pdist

import endotwin
import endotwin.synth
from endotwin.anatomy import CLASSES
from endotwin.anatomy.classes import DEEPEST_MM, JAWS_MM
from endotwin.errors import OptionError, TrajectoryError, TwinError
from endotwin.light.film import Film
from endotwin.surface.casting import Caster
from endotwin.surface.vectors import dot, unit
from endotwin.synth import Order, Trajectory, parse_labels, prove, with_polyps
from endotwin.synth.job import Job, fingerprint
from endotwin.synth.labels import Labeller
from endotwin.synth.motion.crossing import crossings
from endotwin.synth.polyps import PolypOptions, parse_polyp
from endotwin.synth.run.dataset import make_job
from endotwin.synth.variation import Variation
from endotwin.twin import Twin
from endotwin.twin.polyps import Polyp

SIZES = [("Ip", 4.0), ("Ip", 7.0), ("Is", 3.0), ("Is", 6.0), ("IIa", 4.0), ("IIa", 9.0)]
SIZES += [("IIb", 4.0), ("IIb", 8.0), ("IIc", 4.0), ("IIc", 8.0)]
SEVERAL = ["Is:size=4,count=2", "Ip:size=4", "IIa:size=5"]


@pytest.fixture(scope="module")
def bare() -> Twin:
    return tube_twin.fitted(tube_twin.seen(tube_twin.surface()))


def on_the_wall(s: float) -> str:
    """A place of the tube's wall at angle ``s`` of its axis, beside it in y."""
    x, y, z = tube_twin.axis(np.array(s))[0] + [0, tube_twin.RADIUS_MM, 0]
    return f"x={x:.4f},y={y:.4f},z={z:.4f}"


@pytest.fixture(scope="module", params=SIZES, ids=lambda case: f"{case[0]} of {case[1]:g} mm")
def one(request, bare) -> tuple[str, float, Twin, Polyp]:
    """A twin with one polyp in the middle of the tube."""
    kind, size_mm = request.param
    twin, _ = with_polyps(bare, f"{kind}:size={size_mm},{on_the_wall(0.8)}", seed=3)
    return kind, size_mm, twin, twin.polyps[0]


def mesh_of(twin: Twin, polyp: Polyp) -> trimesh.Trimesh:
    """The polyp's own triangles, in axes about its foot, z into the lumen."""
    first, count = polyp.triangles
    points = twin.surface.vertices_mm + twin.surface.origin_mm - polyp.place_mm
    axis = np.array(polyp.axis)
    side = unit(np.cross(axis, np.eye(3)[np.abs(axis).argmin()]))
    points = points @ np.stack([side, np.cross(axis, side), axis], axis=1)
    mesh = trimesh.Trimesh(points, twin.surface.triangles[first : first + count], process=False)
    mesh.remove_unreferenced_vertices()
    return mesh


def widths_mm(mesh: trimesh.Trimesh, heights_mm: np.ndarray) -> np.ndarray:
    """Greatest diameters of sections across the axis."""
    return np.array([pdist(mesh.section([0, 0, 1], [0, 0, h]).vertices).max() for h in heights_mm])


def test_a_polyp_is_as_wide_as_was_asked_for(one):
    kind, size_mm, twin, polyp = one
    mesh = mesh_of(twin, polyp)
    if kind == "Ip":
        width_mm = widths_mm(mesh, np.linspace(0.4, 0.95, 45) * polyp.height_mm).max()
    else:
        width_mm = pdist(mesh.convex_hull.vertices[:, :2]).max()
    assert width_mm == pytest.approx(size_mm, rel=0.03)
    assert polyp.size_mm == pytest.approx(width_mm, rel=0.03)


def test_a_polyp_is_as_high_above_the_true_wall_as_its_class_says(one):
    """Height over the tube's own radius, in closed form."""
    kind, size_mm, twin, polyp = one
    mesh = mesh_of(twin, polyp)
    top = mesh.vertices[:, 2].max()
    first, count = polyp.triangles
    points = twin.surface.vertices_mm[twin.surface.triangles[first : first + count]].reshape(-1, 3)
    _, inward = tube_twin.to_axis(points + twin.surface.origin_mm)
    risen_mm = np.max(tube_twin.RADIUS_MM - np.linalg.norm(inward, axis=1))
    if kind in ("IIb", "IIc"):
        inward_mm = tube_twin.RADIUS_MM - np.linalg.norm(inward, axis=1)
        risen_mm = inward_mm[np.abs(inward_mm).argmax()]
    assert polyp.height_mm == pytest.approx(risen_mm, rel=0.05, abs=0.02)
    assert polyp.height_mm == pytest.approx(CLASSES[kind].usual_height_mm(size_mm), rel=0.02)
    told = {"Ip": top > size_mm, "Is": top > JAWS_MM, "IIa": top < JAWS_MM}
    told |= {"IIb": polyp.height_mm == 0, "IIc": -DEEPEST_MM < polyp.height_mm < 0}
    assert told[kind]


def test_a_pedunculated_polyp_has_a_stalk_and_others_none(one):
    kind, _, twin, polyp = one
    mesh = mesh_of(twin, polyp)
    if polyp.height_mm <= 0:
        return
    low, high = widths_mm(mesh, np.array([0.3, 0.7]) * polyp.height_mm)
    assert low < 0.5 * high if kind == "Ip" else low > 0.95 * high


def test_the_mesh_stays_a_tube_without_seams(one, bare):
    *_, twin, polyp = one
    before, after = (
        trimesh.Trimesh(each.surface.vertices_mm, each.surface.triangles, process=False)
        for each in (bare, twin)
    )
    assert after.is_winding_consistent
    assert after.euler_number == before.euler_number
    shared = np.bincount(np.unique(after.edges_sorted, axis=0, return_inverse=True)[1])
    assert shared.max() == 2
    assert (shared == 1).sum() == len(trimesh.grouping.group_rows(before.edges_sorted, require_count=1))
    assert after.area_faces.min() > 0
    if polyp.height_mm:  # a flat one's facets lie in one plane with those that they were cut from
        assert len(crossings(twin.surface)) < 3, "a ray within the plane of a facet may be told to meet it"


def test_the_polyp_is_smooth(one):
    """No edge of it is longer than a tenth of its size, nor bent by more than 40°."""
    _, size_mm, twin, polyp = one
    mesh = mesh_of(twin, polyp)
    assert mesh.edges_unique_length.max() < max(size_mm / 10, 0.35)
    assert np.degrees(np.quantile(mesh.face_adjacency_angles, 0.999)) < 40


def test_normals_are_those_of_the_mesh(one):
    *_, twin, polyp = one
    first, count = polyp.triangles
    triangles = twin.surface.triangles[first : first + count]
    a, b, c = twin.surface.vertices_mm[triangles].astype(np.float64).transpose(1, 0, 2)
    facing = unit(np.cross(b - a, c - a))
    told = unit(twin.surface.normals[triangles].astype(np.float64).mean(axis=1))
    degrees = np.degrees(np.arccos(np.clip(dot(facing, told), -1, 1)))
    assert np.median(degrees) < 2
    assert np.quantile(degrees, 0.99) < 15


def test_the_wall_elsewhere_is_unchanged_bit_for_bit(one, bare):
    *_, twin, polyp = one
    count = len(bare.surface.vertices_mm)
    far = np.linalg.norm(bare.surface.vertices_mm + bare.surface.origin_mm - polyp.place_mm, axis=1)
    away = far > polyp.size_mm
    for name in ("vertices_mm", "normals", "seen_by", "nearest_mm", "filled"):
        before, after = getattr(bare.surface, name), getattr(twin.surface, name)
        assert after.dtype == before.dtype
        np.testing.assert_array_equal(after[:count][away], before[away])
    for name, before in bare.materials.per_vertex.items():
        np.testing.assert_array_equal(twin.materials.per_vertex[name][:count][away], before[away])
    whole = away[bare.surface.triangles].all(axis=1)
    kept = (twin.surface.triangles < count).all(axis=1)
    kept[kept] = away[twin.surface.triangles[kept]].all(axis=1)
    np.testing.assert_array_equal(twin.surface.triangles[kept], bare.surface.triangles[whole])
    assert (~away).sum() < 0.1 * count


def test_a_flat_lesion_changes_colours_and_no_shape(bare):
    """Every ray meets the surface of before at the same depth, with the same normal."""
    twin, _ = with_polyps(bare, f"IIb:size=7,{on_the_wall(0.8)}", seed=3)
    count = len(bare.surface.vertices_mm)
    for name in ("vertices_mm", "normals"):
        before, after = getattr(bare.surface, name), getattr(twin.surface, name)
        np.testing.assert_array_equal(after[:count], before)
    (before, after), own = (
        [Labeller(job_of(each, "depth_exr,normals,albedo")).frame(0) for each in (bare, twin)],
        Labeller(job_of(twin, "polyp")).frame(0)["polyp"] > 0,
    )
    assert own.sum() > 100
    np.testing.assert_allclose(after["depth_exr"], before["depth_exr"], rtol=1e-5)
    np.testing.assert_allclose(after["normals"], before["normals"], atol=1e-3)
    assert (np.abs(after["albedo"] - before["albedo"]).max(axis=2) > 5e-3)[own].mean() > 0.9


def test_depth_follows_a_depressed_lesion(bare):
    """Where its floor is seen, the wall is farther by its depth over the cosine of the ray to it."""
    spec = f"IIc:size=8,height=-0.9,{on_the_wall(0.8)}"
    twin, _ = with_polyps(bare, spec, seed=3)
    at_rest, sunk = (Caster(each.surface) for each in (bare, twin))
    foot, axis = np.array(twin.polyps[0].place_mm) - twin.surface.origin_mm, np.array(twin.polyps[0].axis)
    start, towards = (foot + 5 * axis).astype(np.float32)[None], -axis.astype(np.float32)[None]
    before_mm, after_mm = (caster.cast_rays(start, towards)[2][0] for caster in (at_rest, sunk))
    assert after_mm - before_mm == pytest.approx(0.9, abs=0.15)
    depths = [Labeller(job_of(each, "depth_exr")).frame(0)["depth_exr"] for each in (bare, twin)]
    own = Labeller(job_of(twin, "polyp")).frame(0)["polyp"] > 0
    assert (depths[1] - depths[0])[own].min() > -0.05
    assert (depths[1] - depths[0])[own].max() > 0.5


def test_haemoglobin_reddens_by_its_index(bare):
    """IHb = 32·log2(R/G) of displayed values, of the polyp above the wall about it."""
    index = []
    for ihb in (0.0, 8.0):
        twin, _ = with_polyps(bare, f"Is:size=6,ihb={ihb},{on_the_wall(0.8)}", seed=3)
        first, count = twin.polyps[0].triangles
        own = np.unique(twin.surface.triangles[first : first + count])
        red, green, _ = (twin.materials.base_color[own].astype(np.float64) ** twin.response.gamma).T
        index.append(32 * np.log2(red / green))
    np.testing.assert_allclose(index[1] - index[0], 8, atol=0.01)


def poses() -> np.ndarray:
    return np.stack([tube_twin.pose(s) for s in (0.3, 0.31, 0.32)])


def job_of(twin: Twin, labels: str = "all", motion=None) -> Job:
    trajectory = Trajectory(poses(), np.arange(3) / 10, "three poses")
    names = parse_labels(labels, motion is not None, polyps=True)
    return make_job(twin, trajectory, 0, names, "c3vd", twin.camera.scaled(2), Variation(), motion)


@pytest.fixture(scope="module")
def several(bare) -> Twin:
    trajectory = Trajectory(poses(), np.arange(3) / 10, "three poses")
    return with_polyps(bare, SEVERAL, 1, trajectory)[0]


def test_labels_are_what_an_independent_caster_meets(several):
    """Open3D's rays into a mesh whose triangles carry the numbers that the table gives."""
    from endotwin.fusion._open3d import o3c, o3d

    job = job_of(several, "depth_exr,polyp")
    images = Labeller(job).frame(0)
    surface = several.surface
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3c.Tensor(surface.vertices_mm), o3c.Tensor(surface.triangles.astype(np.uint32)))
    pose = surface.to_local(poses()[0])
    towards = job.camera.pixel_directions @ pose[:3, :3].T
    rays = np.concatenate([np.broadcast_to(pose[:3, 3], towards.shape), towards], axis=-1)
    met = scene.cast_rays(o3c.Tensor(np.ascontiguousarray(rays, np.float32)))
    triangle = met["primitive_ids"].numpy().astype(np.int64)
    told = np.zeros(triangle.shape, np.uint8)
    for number, polyp in enumerate(several.polyps, 1):
        first, count = polyp.triangles
        told[(triangle >= first) & (triangle < first + count)] = number
    assert images["polyp"].dtype == np.uint8
    assert (images["polyp"] != told).mean() < 1e-4
    assert np.isin([1, 2, 3, 4], images["polyp"]).sum() >= 3
    depth_mm = met["t_hit"].numpy() * job.camera.pixel_directions[..., 2]
    seen = np.isfinite(images["depth_exr"]) & np.isfinite(depth_mm)
    off_mm = np.abs(images["depth_exr"] - depth_mm)[seen]
    assert np.quantile(off_mm, 0.999) < 1e-3


def test_places_drawn_by_chance_are_seen_apart_and_clear_of_the_camera(several):
    feet = np.array([polyp.place_mm for polyp in several.polyps])
    assert [polyp.kind for polyp in several.polyps] == ["Is", "Is", "Ip", "IIa"]
    assert pdist(feet).min() > 4
    centres = poses()[:, :3, 3]
    points = several.surface.vertices_mm + several.surface.origin_mm
    for polyp in several.polyps:
        first, count = polyp.triangles
        own = points[np.unique(several.surface.triangles[first : first + count])]
        assert np.linalg.norm(own[:, None] - centres, axis=2).min() > 1
    shown = Labeller(job_of(several, "polyp"))
    assert set(np.unique([shown.frame(k)["polyp"] for k in range(3)])) == {0, 1, 2, 3, 4}


def test_a_seed_decides_shapes_and_places(bare):
    trajectory = Trajectory(poses(), np.arange(3) / 10, "three poses")
    first, again, other = (with_polyps(bare, "Is:size=4", seed, trajectory)[0] for seed in (1, 1, 2))
    assert fingerprint(first) == fingerprint(again)
    assert len({fingerprint(twin) for twin in (bare, first, other)}) == 3
    assert first.polyps[0].place_mm != other.polyps[0].place_mm


def test_a_twin_with_polyps_is_saved_and_takes_more(bare, several, tmp_path):
    several.save(tmp_path / "twin")
    loaded = Twin.load(tmp_path / "twin")
    assert loaded.polyps == several.polyps
    assert fingerprint(loaded) == fingerprint(several)
    more = endotwin.with_polyps(loaded, "IIa:size=4", seed=5)
    assert [polyp.kind for polyp in more.polyps] == ["Is", "Is", "Ip", "IIa", "IIa"]
    for before, after in zip(several.polyps, more.polyps, strict=False):
        meshes = [mesh_of(*pair) for pair in ((several, before), (more, after))]
        np.testing.assert_array_equal(meshes[0].vertices, meshes[1].vertices)
    damaged = replace(several, polyps=(replace(several.polyps[0], triangles=(10**8, 3)),))
    damaged.save(tmp_path / "damaged")
    with pytest.raises(TwinError, match="polyp"):
        Twin.load(tmp_path / "damaged")


def test_photos_are_not_fitted_or_aligned_to_a_twin_with_polyps_which_they_do_not_show(several):
    for found in (endotwin.fit_twin, endotwin.align_twin):
        with pytest.raises(TwinError, match="take the one without them"):
            found(several)


def test_a_polyp_beside_another_leaves_it_as_it_is(bare):
    """Wall of both gives the second its colour, and its triangles are the first one's neighbours."""
    x, y, z = tube_twin.axis(np.array(0.8))[0] + [0, tube_twin.RADIUS_MM, 0]
    apart = 6.2 * tube_twin.axis(np.array(0.8))[1]
    beside = "x={:.4f},y={:.4f},z={:.4f}".format(*(np.array([x, y, z]) + apart))
    alone, _ = with_polyps(bare, f"Is:size=4,{on_the_wall(0.8)}", 0)
    both, _ = with_polyps(alone, f"Is:size=4,{beside}", 1)
    assert np.linalg.norm(np.subtract(both.polyps[0].place_mm, both.polyps[1].place_mm)) < 7
    meshes = [mesh_of(twin, twin.polyps[0]) for twin in (alone, both)]
    np.testing.assert_array_equal(meshes[0].vertices, meshes[1].vertices)
    assert both.polyps[1].triangles[1] == pytest.approx(alone.polyps[0].triangles[1], rel=0.3)
    assert len(crossings(both.surface)) < 3


def test_a_film_lies_on_the_polyp_as_on_the_wall(bare):
    count = len(bare.surface.vertices_mm)
    film = Film(np.arange(count, dtype=np.int32), bare.surface.normals, np.ones(count, np.float32))
    wet = replace(bare, materials=replace(bare.materials, film=film))
    twin, _ = with_polyps(wet, f"Is:size=6,{on_the_wall(0.8)}", seed=3)
    film = twin.materials.film
    assert len(film) == len(twin.surface.vertices_mm)
    np.testing.assert_allclose(film.weight, 1, atol=1e-6)
    degrees = np.degrees(np.arccos(np.clip(dot(film.normal, twin.surface.normals), -1, 1)))
    assert degrees.max() < 1


@pytest.mark.slow
@pytest.mark.parametrize("specs", [(), ("peristalsis:amplitude=1,width=0.1", "breathing:amplitude=2")])
def test_a_dataset_with_polyps_is_proved_and_another_numbering_is_not(bare, tmp_path, specs):
    names = [*poses(), *(tube_twin.pose(s) for s in (0.33, 0.34))]
    endotwin.synthesize(
        replace(bare, camera=bare.camera.scaled(2)),
        np.stack(names),
        tmp_path / "d",
        polyps=SEVERAL,
        motion=specs,
        labels="all",
        seed=1,
    )
    proof = prove(tmp_path / "d")
    assert proof.holds, proof.broken
    (row,) = [row for row in proof.rows if row.claim == "polyps"]
    assert row.pixels > 1000
    document = json.loads((tmp_path / "d" / "dataset.json").read_text())
    assert [polyp["paris"] for polyp in document["polyps"]] == ["0-Is", "0-Is", "0-Ip", "0-IIa"]
    assert "0-IIa" in (tmp_path / "d" / "datasheet.html").read_text()
    file = tmp_path / "d" / "0001_polyp.png"
    cv2.imwrite(str(file), (5 - cv2.imread(str(file), cv2.IMREAD_UNCHANGED)) % 5)
    assert not prove(tmp_path / "d").holds


@pytest.mark.slow
def test_any_number_of_workers_writes_the_same_bytes_of_fluids_about_polyps(bare, tmp_path):
    path = np.stack([tube_twin.pose(s) for s in np.linspace(0.3, 0.5, 40)])
    for workers in (1, 2):
        out = tmp_path / str(workers)
        endotwin.synthesize(bare, path, out, polyps=SEVERAL, fluids=["mucus:size=8"], seed=1, workers=workers)
    files = [{file.name: file.read_bytes() for file in (tmp_path / n).iterdir()} for n in ("1", "2")]
    assert files[0] == files[1]
    assert {"0039_polyp.png", "0039_fluid.png"} <= files[0].keys()


def test_a_painted_region_stays_where_it_was_painted(bare, tmp_path):
    """Weights of one a vertex of the bare twin hold on the one with polyps."""
    half = (bare.surface.vertices_mm[:, 1] > 0).astype(np.float32)
    np.save(tmp_path / "half.npy", half)
    (tmp_path / "vary.yaml").write_text(
        "regions: [{name: half, vertices: half.npy, material: [base_color=0.1]}]\n"
    )
    job = Order(poses(), vary=tmp_path / "vary.yaml", polyps="Is:size=4", labels="rgb").job(bare)
    (region,) = job.regions
    assert len(region.weight) == len(job.twin.surface.vertices_mm) > len(half)
    sure = np.abs(job.twin.surface.vertices_mm[:, 1]) > 6
    painted = job.twin.surface.vertices_mm[:, 1] > 0
    np.testing.assert_allclose(region.weight[sure], painted[sure], atol=1e-6)


def test_poses_that_a_polyp_comes_too_near_to_are_dropped(bare, tmp_path):
    spec = f"Ip:size=6,height=14,{on_the_wall(0.45)}"
    path = np.stack([tube_twin.pose(s) for s in (0.2, 0.25, 0.45)])
    summary = endotwin.synthesize(bare, path, tmp_path / "d", polyps=spec)
    assert summary.frames == 2
    with pytest.raises(TrajectoryError, match="none of its 1 poses"):
        endotwin.synthesize(bare, path[2:], tmp_path / "e", polyps=spec)


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        ("III", "no known class; write Ip or Is or IIa or IIb or IIc"),
        ("IIb:height=1", "0 to 0 mm high"),
        ("IIc:size=20,height=-1.5", "-1.2 to 0 mm high"),
        ("Is:size=0.2", "size lies between 1 and 50 mm"),
        ("Is:size=2", "higher than 2.5 mm"),
        ("IIa:size=9,height=3", "0 to 2.5 mm high"),
        ("Ip:size=5,height=4", "5.5 to 12.5 mm high"),
        ("Is:count=0", "count"),
        ("IIa:count=1000000", "255 polyps at most"),
        ("Is:count=2,x=0,y=12,z=0", "count"),
        ("Is:x=1", "give x, y and z"),
        ("Is:x=15,y=0,z=40", "mm from the surface"),
        ("Ip:size=20", "no place that was tried holds it"),
        (f"Ip:size=20,{on_the_wall(0.8)}", "cannot grow"),
        ("Is:colour=3", "'colour=3' is not understood"),
    ],
)
def test_what_cannot_grow_is_refused_in_a_sentence(bare, spec, said):
    trajectory = Trajectory(poses(), np.arange(3) / 10, "three poses")
    with pytest.raises(OptionError, match=said) as refused:
        with_polyps(bare, spec, 0, trajectory)
    assert "\n" not in str(refused.value)


@pytest.mark.slow
def test_a_place_that_is_taken_and_a_hole_are_refused(bare):
    holed = tube_twin.fitted(tube_twin.seen(tube_twin.surface(holes=40)))
    refused = 0
    for s in np.linspace(0.2, 1.3, 12):
        try:
            with_polyps(holed, f"IIa:size=4,{on_the_wall(s)}", 0)
        except OptionError as error:
            refused += "not whole" in str(error) or "from the surface" in str(error)
    assert refused
    place = on_the_wall(0.8)
    with pytest.raises(OptionError, match="another polyp stands there"):
        with_polyps(bare, [f"Is:size=4,{place}", f"IIa:size=4,{place}"], 0)


def test_the_label_needs_polyps_and_polyps_a_fit(bare):
    trajectory = Trajectory(poses(), np.arange(3) / 10, "three poses")
    with pytest.raises(OptionError, match="--polyp"):
        make_job(bare, trajectory, 0, ("polyp",), "c3vd", bare.camera, Variation())
    with pytest.raises(TwinError, match="fit"):
        with_polyps(tube_twin.unfitted(bare), "Is", 0)


@settings(deadline=None, suppress_health_check=list(HealthCheck))
@given(
    kind=st.sampled_from([*CLASSES, "0-Is", ""]),
    options=st.dictionaries(
        st.sampled_from(["size", "height", "count", "ihb", "x", "u"]),
        st.one_of(st.floats(), st.integers(-5, 300), st.text(max_size=4)),
        max_size=4,
    ),
)
def test_options_make_a_polyp_that_its_class_allows_or_a_sentence(kind, options):
    spec = f"{kind}:{','.join(f'{name}={value}' for name, value in options.items())}"
    try:
        found, parsed = parse_polyp(spec)
    except OptionError as error:
        assert str(error).startswith("polyp ")
        return
    assert isinstance(parsed, PolypOptions)
    low, high = CLASSES[found].height_range_mm(parsed.size)
    assert parsed.count >= 1
    assert low <= (parsed.height or CLASSES[found].usual_height_mm(parsed.size)) <= high


def test_rays_from_within_the_lumen_never_pass_through(several):
    """10⁵ rays from the axis meet the wall's lumen side."""
    generator = np.random.default_rng(0)
    directions = unit(generator.standard_normal((100_000, 3))).astype(np.float32)
    centre = several.surface.to_local(tube_twin.pose(0.7))[:3, 3]
    origins = np.broadcast_to(centre.astype(np.float32), directions.shape)
    triangle, *_ = Caster(several.surface).cast_rays(origins, directions)
    a, b, c = several.surface.vertices_mm[several.surface.triangles[triangle[triangle >= 0]]].transpose(
        1, 0, 2
    )
    assert (dot(np.cross(b - a, c - a), directions[triangle >= 0]) < 0).all()
    assert (triangle >= 0).mean() > 0.9

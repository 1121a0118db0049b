"""The published method: its geometry from depth maps, and that its training learns."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import tube_sequence
from scenes import look, pinhole, sphere

import endotwin
from endotwin.fit import endopbr
from endotwin.fit.checkpoint import Checkpoint, identity
from endotwin.surface import Surface
from endotwin.twin import Registration, Source, Twin

pytestmark = pytest.mark.slow

PIXELS = 2048


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """A small table and few pixels a step; one thread, as in the tests of the fit."""
    monkeypatch.setattr(endopbr, "LOG2_SLOTS", 12)
    monkeypatch.setattr(endopbr, "PIXELS_A_STEP", PIXELS)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def tube(tmp_path_factory) -> Twin:
    return endotwin.fuse_twin(tube_sequence.write(tmp_path_factory.mktemp("endopbr") / "tube", frames=10))


@pytest.fixture(scope="module")
def inside_sphere(tmp_path_factory) -> tuple[Twin, dict, np.ndarray]:
    """A photo from inside a sphere of 15 mm about the origin: twin, geometry, pose."""
    folder, camera = tmp_path_factory.mktemp("sphere"), pinhole(160, 120)
    T_world_camera = look((3.0, -2.0, 5.0), (0.5, 0.2, -1.0))
    sequence = sphere(15.0).sequence(folder, camera, T_world_camera[None])
    surface = Surface.from_mesh(
        np.array([[50.0, 0, 0], [0, 50, 0], [0, 0, 50]]), np.array([[0, 1, 2]]), np.tile([0, 0, 1.0], (3, 1))
    )
    twin = Twin(surface, camera, Source(str(folder), "c3vd"))
    frame = sequence.frame(0)
    # One pixel without depth takes its neighbours' gradients with it.
    frame.depth_mm[60, 80] = np.nan
    return twin, endopbr.photo_geometry(twin, frame, np.ones((120, 160), bool)), T_world_camera


def test_points_of_a_photo_lie_on_the_surface_in_its_local_frame(inside_sphere):
    twin, geometry, T_world_camera = inside_sphere
    world = geometry["points_mm"] + twin.surface.origin_mm
    np.testing.assert_allclose(np.linalg.norm(world, axis=1), 15.0, atol=2e-3)
    distance_mm = np.linalg.norm(world - T_world_camera[:3, 3], axis=1)
    np.testing.assert_allclose(np.exp(geometry["log_distance"]), distance_mm, rtol=1e-4)


def test_normals_from_the_depth_gradient_are_those_of_the_sphere(inside_sphere):
    twin, geometry, T_world_camera = inside_sphere
    world = geometry["points_mm"] + twin.surface.origin_mm
    ray = world - T_world_camera[:3, 3]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    cos = (world * ray).sum(axis=1) / 15.0
    # One-sided differences at the image's border are half a pixel off.
    np.testing.assert_allclose(np.degrees(np.arccos(geometry["cos"])), np.degrees(np.arccos(cos)), atol=1.5)
    assert np.median(np.abs(geometry["cos"] - cos)) < 2e-4
    np.testing.assert_allclose(geometry["sin2"] + geometry["cos"] ** 2, 1, atol=1e-5)
    forward = ray @ T_world_camera[:3, 2]
    np.testing.assert_allclose(np.exp(geometry["log_cos_axis"]), forward, rtol=1e-4)


def test_pixels_without_a_depth_gradient_are_left_out(inside_sphere):
    """A hole, and its four neighbours whose central differences need it."""
    assert len(inside_sphere[1]["cos"]) == 160 * 120 - 5


def test_photos_aligned_apart_from_their_depth_have_points_and_normals_of_the_surface(tube):
    """As far from the cylinder that was photographed as the surface is, wherever its photos were moved."""
    twists = np.c_[np.zeros((10, 3)), np.random.default_rng(0).normal(0, 1.0, (10, 3))]
    aligned = replace(tube, registration=Registration(tuple(map(tuple, twists))))
    sequence = aligned.sequence()
    pixels = endopbr.Photos(aligned, sequence, torch.device("cpu"))[1]
    world = pixels["points_mm"].numpy() + tube.surface.origin_mm
    to_wall_mm = tube_sequence.RADIUS_MM - np.hypot(world[:, 0], world[:, 1])
    to_cap_mm = tube_sequence.CAP_MM - world[:, 2]
    assert np.median(np.abs(np.minimum(to_wall_mm, to_cap_mm))) < 0.05
    ray = world - sequence.T_world_camera[1][:3, 3]
    distance_mm = np.linalg.norm(ray, axis=1)
    np.testing.assert_allclose(pixels["log_distance"].exp(), distance_mm, rtol=1e-4)
    outward = np.where((to_cap_mm < to_wall_mm)[:, None], [0, 0, 1.0], world * [1, 1, 0])
    cos = (ray * outward).sum(axis=1) / distance_mm / np.linalg.norm(outward, axis=1)
    assert np.median(np.abs(pixels["cos"].numpy() - cos)) < 0.02


def test_a_few_steps_give_a_finite_lambertian_twin_that_renders(tube):
    twin = endotwin.fit_twin(tube, "endopbr", epochs=1)
    assert twin.materials.diffuse == "lambert"
    for value in twin.materials.per_vertex.values():
        assert (
            value.dtype == np.float32 and np.isfinite(value).all() and value.min() >= 0 and value.max() <= 1
        )
    assert np.isfinite([twin.light.L0, twin.light.n, twin.light.q, twin.response.gamma]).all()
    assert twin.record["fit"]["method"] == "endopbr"
    assert (twin.record["fit"]["steps"], twin.record["fit"]["epochs"]) == (2, 1)
    assert np.isfinite(endotwin.evaluate(twin).psnr)


def test_more_steps_predict_held_out_photos_better_and_bring_the_light_nearer(tube):
    few, many = (endotwin.fit_twin(tube, "endopbr", epochs=epochs) for epochs in (1, 20))
    assert endotwin.evaluate(many).psnr > endotwin.evaluate(few).psnr + 3
    assert abs(many.light.n - tube_sequence.CONE) < abs(few.light.n - tube_sequence.CONE)


def test_the_loss_falls_over_thirty_steps_on_one_set_of_pixels(tube):
    torch.manual_seed(0)
    sequence = tube.source.open()
    pixels = endopbr.Photos(tube, sequence, torch.device("cpu"))[1]
    chosen = np.random.default_rng(0).integers(0, len(pixels["cos"]), PIXELS)
    pixels = {name: value[chosen] for name, value in pixels.items()}
    low, high = tube.surface.vertices_mm.min(axis=0), tube.surface.vertices_mm.max(axis=0)
    field, shared = (
        endopbr.Field(low.astype(np.float64), high.astype(np.float64)),
        endopbr.SharedParameters(10.0),
    )
    optimizer = torch.optim.Adam([*field.parameters(), *shared.parameters()], lr=1e-2, eps=1e-15)

    def loss() -> float:
        with torch.no_grad():
            shown = endopbr._predict(pixels, *field(pixels["points_mm"]), shared)
        return float((shown - pixels["color"] / 255).abs().mean())

    losses = [loss()]
    for _ in range(30):
        endopbr._step(field, shared, optimizer, pixels)
        losses.append(loss())
    assert np.isfinite(losses).all()
    assert losses[-1] < 0.5 * losses[0]


def test_the_same_seed_gives_the_same_twin(tube):
    one, other = (endotwin.fit_twin(tube, "endopbr", epochs=1, seed=5) for _ in range(2))
    np.testing.assert_allclose(one.materials.base_color, other.materials.base_color, atol=1e-5)
    np.testing.assert_allclose(one.light.L0, other.light.L0, rtol=1e-4)


def test_a_training_goes_on_only_from_the_same_photos_places_and_not_from_beyond_its_end(tube, tmp_path):
    moved = replace(tube, registration=Registration(((1.0,) * 6,) * 10))
    assert identity(moved) != identity(tube)
    parameter = torch.nn.Parameter(torch.zeros(3))
    optimizer = torch.optim.Adam([parameter])
    parameter.grad = torch.ones(3)
    optimizer.step()
    kept = Checkpoint(tmp_path / "kept", identity(tube), optimizer)
    kept._written = -np.inf
    kept.keep(7, 1.5)
    assert kept.resume(7) == (7, 1.5) and kept.resume(6) == (0, 0.0)
    assert Checkpoint(tmp_path / "kept", identity(moved), optimizer).resume(7) == (0, 0.0)


def test_of_a_damaged_checkpoint_nothing_is_restored(tmp_path):
    """Its second parameter is of another size, or its seconds are no number."""

    def training(size: int, value: float) -> torch.optim.Adam:
        parameters = [torch.nn.Parameter(torch.full((each,), value)) for each in (3, size)]
        return torch.optim.Adam(parameters)

    def write(size: int, seconds: float | str) -> None:
        optimizer = training(size, 1.0)
        sum(each.sum() for each in optimizer.param_groups[0]["params"]).backward()
        optimizer.step()
        kept = Checkpoint(tmp_path / "kept", "same", optimizer)
        kept._written = -np.inf
        kept.keep(7, seconds)

    for size, seconds in ((4, 1.5), (5, "soon")):
        write(size, seconds)
        optimizer = training(5, 0.0)
        assert Checkpoint(tmp_path / "kept", "same", optimizer).resume(7) == (0, 0.0)
        assert not optimizer.state
        assert all((each == 0).all() for each in optimizer.param_groups[0]["params"])


def test_a_budget_ends_the_training(tube):
    twin = endotwin.fit_twin(tube, "endopbr", budget_s=0.5)
    assert twin.record["fit"]["steps"] >= 1
    assert twin.record["fit"]["stages"]["train"] < 5


def test_scaling_albedo_and_light_together_leaves_the_rendering_as_trained(tube):
    """The field may put albedo anywhere; the twin's agreed scale must not change what it shows."""
    torch.manual_seed(0)
    low, high = (f(tube.surface.vertices_mm.astype(np.float64), axis=0) for f in (np.min, np.max))
    field, shared = endopbr.Field(low - 1, high + 1), endopbr.SharedParameters(10.0)
    materials, light = endopbr._baked(field, shared, tube)
    with torch.no_grad():
        color = field(torch.from_numpy(tube.surface.vertices_mm).double())[0].numpy()
    np.testing.assert_allclose(materials.base_color * light.L0, color * shared.light.L0, rtol=1e-4)
    assert materials.f0 * light.L0 == pytest.approx(0.04 * shared.light.L0, rel=1e-5)
    seen = tube.surface.seen_by > 0
    assert np.percentile(materials.base_color[seen].max(axis=1), 98) == pytest.approx(0.8, rel=1e-4)
    fitted = replace(tube, materials=materials, light=light, response=shared.response)
    assert fitted.fitted

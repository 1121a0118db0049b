"""The fit recovers the light, the response and the materials that the photos were rendered with."""

import json
import logging
import shutil
import time
from dataclasses import replace
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import tube_sequence

import endotwin
from endotwin.config import FitConfig
from endotwin.effects.processor import Processor
from endotwin.effects.tone import Tone
from endotwin.evaluation.evaluation import covered_pixels
from endotwin.fit import fit, gauss_newton, solve
from endotwin.fit.solve import median_edge_mm
from endotwin.pixels.pace import Pace
from endotwin.pixels.samples import BLACK, Samples, frame_samples, gather
from endotwin.surface.casting import Caster
from endotwin.surface.cells import merged

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Small products finish sooner on one thread than on two that share their cores with other processes."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def tube(tmp_path_factory) -> endotwin.Twin:
    """The unfitted twin of a small painted cylinder."""
    return endotwin.fuse_twin(tube_sequence.write(tmp_path_factory.mktemp("fit") / "tube", frames=10))


def made(sequence: Path) -> dict:
    return json.loads((sequence / "truth" / "made.json").read_text())


def albedo_rmse(twin: endotwin.Twin, sequence: Path) -> float:
    """RMSE of the base colour over the covered pixels of the frames with truth, after one global scale."""
    opened, caster, got, truth = endotwin.open_sequence(sequence), Caster(twin.surface), [], []
    for file in sorted((sequence / "truth").glob("*_albedo.png")):
        index = int(file.name[:4])
        hits = caster.cast(
            opened.camera,
            opened.T_world_camera[index],
            np.isfinite(opened.depth_mm(index)) & opened.lens_mask,
        )
        shape = (opened.camera.height, opened.camera.width)
        covered = covered_pixels(hits, twin.surface, shape).reshape(-1)[hits.pixel]
        got.append(hits.interpolate(twin.surface, twin.materials.base_color)[covered])
        truth.append(cv2.imread(str(file))[..., ::-1].reshape(-1, 3)[hits.pixel][covered] / 255)
    got, truth = np.concatenate(got), np.concatenate(truth)
    assert len(truth) > 100_000
    scale = (got * truth).sum() / (got * got).sum()
    return float(np.sqrt(((scale * got - truth) ** 2).mean()))


def same_materials(one: endotwin.Twin, other: endotwin.Twin) -> bool:
    return all(
        np.array_equal(value, other.materials.per_vertex[name])
        for name, value in one.materials.per_vertex.items()
    )


def test_light_and_response_of_the_example_are_recovered(fitted, example):
    truth = made(example)
    assert fitted.response.gamma == pytest.approx(truth["gamma"], rel=0.03)
    assert fitted.light.n == pytest.approx(truth["light"]["n"], rel=0.05)
    assert fitted.light.q == pytest.approx(truth["light"]["q"], rel=0.04)


def test_base_color_of_the_example_is_the_painted_albedo_up_to_one_scale(fitted, example):
    assert albedo_rmse(fitted, example) < 0.05


def test_the_example_predicts_photos_that_it_never_saw(fitted):
    assert endotwin.evaluate(fitted).psnr_covered > 33


@pytest.mark.long
def test_a_tone_curve_over_the_example_is_found_and_leaves_the_response(fused, example, tmp_path):
    """Beside the light alone γ would be a twelfth too large."""
    toned, curve = tmp_path / "toned", Tone(0.3)
    shutil.copytree(example, toned)
    levels = np.rint(255 * curve.shown(torch.linspace(0, 1, 256)).numpy()).astype(np.uint8)
    for file in toned.glob("*_color.png"):
        cv2.imwrite(str(file), levels[cv2.imread(str(file))])
    bare = fused(0.5)
    bare = replace(bare, source=replace(bare.source, path=str(toned)))
    twin = endotwin.fit_twin(bare)
    assert twin.effects["tone"].contrast == pytest.approx(curve.contrast, abs=0.06)
    assert twin.response.gamma == pytest.approx(made(example)["gamma"], rel=0.03)


@pytest.mark.long
def test_interreflection_that_no_photo_shows_is_fitted_away(fitted):
    forced = fit(fitted, effects={"interreflection": "on"})
    assert forced.decisions["interreflection"].state == "on"
    assert forced.effects["interreflection"].strength == 0
    assert "none of it" in forced.decisions["interreflection"].reason
    assert forced.response.gamma == pytest.approx(fitted.response.gamma, rel=0.01)
    assert endotwin.evaluate(forced).psnr_covered > endotwin.evaluate(fitted).psnr_covered - 0.1


def test_materials_are_physical_and_the_brightest_albedo_has_the_agreed_scale(fitted):
    materials = fitted.materials
    assert materials.base_color.min() >= 0 and materials.base_color.max() <= 1
    assert materials.roughness.min() >= 0 and materials.roughness.max() <= 1
    assert not materials.metallic.any() and 0 < materials.f0 < 0.5
    assert np.percentile(materials.base_color[fitted.surface.seen_by > 0].max(axis=1), 98) == pytest.approx(
        0.8, rel=1e-3
    )
    assert all(value.dtype == np.float32 for value in materials.per_vertex.values())


def test_the_record_tells_the_method_and_the_seconds_of_each_stage(fitted):
    record = fitted.record["fit"]
    assert record["method"] == "twin" and record["undetermined"] == []
    assert record["sharpening_undone"] is None
    assert set(record["stages"]) >= {"gather", "start", "light", "detail"}
    assert sum(record["stages"].values()) == pytest.approx(record["seconds"], rel=0.1, abs=0.1)


def test_light_and_response_of_a_lambertian_tube_are_recovered(tube):
    """Eight photos of 96 × 72 pixels, of a cylinder whose closed end meets its wall in an edge."""
    twin = endotwin.fit_twin(tube)
    assert twin.response.gamma == pytest.approx(tube_sequence.GAMMA, rel=0.08)
    assert twin.light.n == pytest.approx(tube_sequence.CONE, rel=0.08)
    assert twin.light.q == pytest.approx(tube_sequence.FALLOFF, rel=0.08)
    assert endotwin.evaluate(twin).psnr_covered > 36


def test_pixels_beyond_the_number_asked_for_are_drawn_by_the_seed(tube):
    caster = Caster(tube.surface)
    every = gather(tube, Pace(FitConfig(pixels=10**9)), 0, caster)
    some, again, others = (gather(tube, Pace(FitConfig(pixels=10_000)), seed, caster) for seed in (0, 0, 1))
    assert len(some) == pytest.approx(10_000 * len(every) / (8 * 96 * 72), rel=0.1)
    assert torch.equal(some.triangle, again.triangle) and torch.equal(some.cos, again.cos)
    assert len(some) != len(others) or not torch.equal(some.cos, others.cos)
    assert (every.triangle.diff() >= 0).all()


def test_samples_carry_the_color_that_their_surface_point_has_under_their_incidence(tube):
    """The tube's own closed form, from each sample's point, cosine, axis angle and distance."""
    samples = gather(tube, Pace(FitConfig(pixels=10**9)), 0, Caster(tube.surface))
    assert 0.7 < len(samples) / (8 * 96 * 72) <= 1
    corners = tube.surface.vertices_mm[tube.surface.triangles[samples.triangle.numpy()]]
    local = np.einsum("nk,nkc->nc", samples.barycentric.numpy(), corners)
    x, y, z = (local + tube.surface.origin_mm).T
    wave = 0.5 + 0.25 * np.sin(3 * np.arctan2(y, x) + 0.4 * z) + 0.2 * np.cos(0.9 * z)
    light = 40 * np.exp(2 * samples.log_cos_axis.numpy() - 2 * samples.log_distance.numpy())
    radiance = wave[:, None] * [0.8, 0.45, 0.35] * (light * samples.cos.numpy() * 2)[:, None]
    error = np.abs(samples.color.numpy() / 255 - np.clip(radiance, 0, 1) ** tube_sequence.GAMMA)
    assert np.median(error) < 1 / 255
    assert np.percentile(error, 95) < 4 / 255


def test_sharpened_photos_are_fitted_as_they_were_before(tube, monkeypatch):
    processor = Processor(0.0, 1.5, 1.2)
    monkeypatch.setattr(Processor, "evidence", lambda *_: (processor, "told by the lens circle"))
    samples, sequence = gather(tube, Pace(FitConfig(pixels=10**9)), 0, Caster(tube.surface)), tube.sequence()
    for frame in samples.views.frames.tolist():
        here, photo = samples.frame.numpy() == frame, sequence.color(frame)
        before = processor.unsharpened(photo)
        assert (before != photo).any()
        assert (samples.color.numpy()[here] == before.reshape(-1, 3)[samples.pixel.numpy()[here]]).all()


def test_pixels_through_which_the_edge_of_a_shadow_may_run_are_no_samples(tube):
    """They show part of the light; what lies in the shadow, and one pixel farther off, stays."""
    sequence = tube.sequence()
    frame, every = sequence.frame(0), np.ones((72, 96), bool)
    color = frame.color.copy()
    color[55:65, 10:20] = np.random.default_rng(0).integers(0, BLACK + 1, (10, 10, 3))
    parts = [
        frame_samples(tube, Caster(tube.surface), photo, every, 1.0, np.random.default_rng(0))
        for photo in (frame, replace(frame, color=color))
    ]
    lit, shadowed = ({divmod(pixel, 96) for pixel in part.pixel.tolist()} for part in parts)
    edge = set(product(range(54, 66), range(9, 21))) - set(product(range(55, 65), range(10, 20)))
    assert lit - shadowed == edge & lit and len(edge & lit) > 40


@pytest.mark.parametrize("budget_s", (1e-3, 0.3))
def test_a_budget_too_small_still_gives_a_finite_twin_in_about_the_least_time(tube, budget_s):
    twin = endotwin.fit_twin(tube, budget_s=budget_s)
    for value in twin.materials.per_vertex.values():
        assert np.isfinite(value).all() and value.min() >= 0 and value.max() <= 1
    assert np.isfinite([twin.light.L0, twin.light.n, twin.light.q, twin.response.gamma]).all()
    assert endotwin.evaluate(twin).psnr > 20


def test_where_decisions_took_the_lights_time_its_first_step_is_whole_and_a_detail_has_pixels_of_its_vertices(
    tube, monkeypatch
):
    cut, drawn = [], []

    def decided_late(*args):
        *_, late, _ = args
        while not late():
            time.sleep(0.01)
        return decide(*args)

    def solved(product, right, inverse, out_of_time, *more):
        cut.append(out_of_time())
        return conjugate_gradients(product, right, inverse, out_of_time, *more)

    def thinned(samples, count, generator):
        drawn.append(count)
        return take(samples, count, generator)

    decide, conjugate_gradients = solve.decide, gauss_newton.conjugate_gradients
    take = Samples.thinned
    monkeypatch.setattr(solve, "decide", decided_late)
    monkeypatch.setattr(gauss_newton, "conjugate_gradients", solved)
    monkeypatch.setattr(Samples, "thinned", thinned)
    monkeypatch.setattr(solve, "SUMS", 0.0)
    endotwin.fit_twin(tube, budget_s=6)
    assert not cut[0]
    assert drawn[0] == solve.LEAST_A_VERTEX * np.count_nonzero(tube.surface.seen_by)


def test_black_photos_give_a_finite_twin_and_a_warning(tmp_path, caplog):
    folder = tube_sequence.write(tmp_path / "tube", frames=4)
    black = np.full((72, 96, 3), 4, np.uint8)
    for file in folder.glob("*_color.png"):
        cv2.imwrite(str(file), black)
    with caplog.at_level(logging.WARNING, "endotwin"):
        twin = endotwin.fit_twin(endotwin.fuse_twin(folder))
    assert "cannot tell" in caplog.text
    assert all(np.isfinite(value).all() for value in twin.materials.per_vertex.values())
    assert np.isfinite([twin.light.L0, twin.light.n, twin.light.q, twin.response.gamma]).all()


def test_photos_that_show_nothing_of_the_surface_are_an_error(tube, tmp_path):
    """Poses moved by a metre: no ray meets the surface."""
    folder = tube_sequence.write(tmp_path / "tube", frames=3)
    T_world_camera = tube_sequence.poses(3)
    T_world_camera[:, 0, 3] += 1000
    tube_sequence.write_poses(folder / "pose.txt", T_world_camera)
    moved = endotwin.Twin(tube.surface, tube.camera, type(tube.source)(str(folder), "c3vd"))
    with pytest.raises(endotwin.EndotwinError, match="show nothing of the surface"):
        endotwin.fit_twin(moved)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"config": FitConfig(method="nerf")}, "unknown method 'nerf'.*twin, endopbr"),
        ({"epochs": 3}, "epochs belong to the method endopbr"),
        ({"effects": {"noise": "on"}}, "cannot be forced on in a fit.*synth --effects noise=on"),
        ({"config": FitConfig(method="endopbr"), "effects": {"gain": "on"}}, "belong to the method twin"),
    ],
)
def test_options_that_make_no_sense_are_refused(tube, options, message):
    with pytest.raises(endotwin.EndotwinError, match=message):
        fit(tube, **options)


def test_merged_points_are_the_means_of_the_vertices_of_a_cell(tube):
    vertices_mm, cell_mm = tube.surface.vertices_mm, 1.5
    points, group = merged(vertices_mm, cell_mm)
    assert len(points) == group.max() + 1 < len(vertices_mm)
    for number in (0, len(points) // 2, len(points) - 1):
        members = vertices_mm[group == number]
        assert len(np.unique(np.floor(members / cell_mm), axis=0)) == 1
        np.testing.assert_allclose(points[number], members.mean(axis=0), atol=1e-4)
    assert 0 < median_edge_mm(tube.surface) < 2


@pytest.fixture(scope="module")
def colon_direct(data_root) -> endotwin.Twin:
    """64 frames at half of 640×480."""
    return endotwin.fit_twin(endotwin.fuse_twin(data_root / "colon_direct", scale=0.5))


def test_a_full_sequence_reaches_the_promised_accuracy(colon_direct, data_root):
    """With highlights and noise; light cos²θ/d², gamma 1/2.2."""
    assert colon_direct.response.gamma == pytest.approx(1 / 2.2, rel=0.02)
    assert colon_direct.light.q == pytest.approx(2, rel=0.03)
    assert colon_direct.light.n == pytest.approx(2, rel=0.05)
    assert albedo_rmse(colon_direct, data_root / "colon_direct") <= 0.03
    scores = endotwin.evaluate(colon_direct)
    assert scores.psnr >= 38.5
    assert scores.ssim >= 0.97
    assert scores.psnr_covered >= 41


def test_samples_carry_the_poses_and_the_camera_of_their_photos(tube):
    samples = gather(tube, Pace(FitConfig(pixels=10_000)), 0, Caster(tube.surface))
    views, poses = samples[::7].views, tube.sequence().T_world_camera
    assert list(views.frames) == tube.source.training(len(poses)) and views.camera == tube.camera
    np.testing.assert_allclose(tube.surface.to_world(views.T_local_camera), poses[views.frames], atol=1e-9)
    assert (views.frames[views.row(samples.frame)] == samples.frame.numpy()).all()

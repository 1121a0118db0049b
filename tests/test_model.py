"""The pixel model's derivatives, and the normal equations made of them, against dense float64 references."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from endotwin.effects.coat import Coat
from endotwin.effects.tone import Tone
from endotwin.effects.vignetting import Vignetting
from endotwin.fit.linear import conjugate_gradients, joint_minimum
from endotwin.fit.mesh_pattern import MeshPattern
from endotwin.fit.model import EVERY_GLOBAL, Globals, at_pixels, linearise, predict
from endotwin.fit.normal_equations import Residual, assemble, robust_cost
from endotwin.light.bounced import Bounce
from endotwin.light.guides import Guided
from endotwin.pixels.samples import Samples, discontinuities
from endotwin.pixels.start import DIFFUSE_SIN2
from endotwin.twin import Light, Response

SHARED = Globals.of(Light(L0=90.0, n=1.8, q=2.1), Response(0.43), f0=0.05)
WIDTH = 0.03


@pytest.fixture(scope="module")
def triangles() -> np.ndarray:
    """A 4 × 4 grid of vertices, 18 triangles; the last touches no sample."""
    corner = [(4 * i + j, 4 * i + j + 1, 4 * i + j + 4, 4 * i + j + 5) for i in range(3) for j in range(3)]
    return np.array([t for a, b, c, d in corner for t in ((a, b, c), (b, d, c))])


def made_samples(count: int, triangle_count: int, seed: int = 0) -> Samples:
    """Random samples in float64, sorted by triangle; a tenth of the channels clipped."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand(count, generator=generator, dtype=torch.float64)

    weights = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    cos = torch.cat([uniform(0.15, 0.999)[: count // 2], 1 - uniform(1e-3, 0.02)[count // 2 :]])
    color = torch.randint(10, 230, (count, 3), generator=generator, dtype=torch.uint8)
    color[torch.rand(count, 3, generator=generator) < 0.1] = 255
    return Samples(
        triangle=torch.randint(0, triangle_count, (count,), generator=generator).sort().values,
        barycentric=weights / weights.sum(dim=1, keepdim=True),
        cos=cos,
        sin2=1 - cos**2,
        log_cos_axis=uniform(0.5, 1.0).log(),
        log_distance=uniform(6.0, 40.0).log(),
        color=color,
        frame=torch.zeros(count, dtype=torch.int32),
        pixel=torch.zeros(count, dtype=torch.int32),
    )


def single(samples: Samples) -> Samples:
    return Samples(
        **{
            name: value.float() if value is not None and value.is_floating_point() else value
            for name, value in vars(samples).items()
        }
    )


def made_materials(count: int, seed: int = 1) -> torch.Tensor:
    """Base colour in 0.1 to 0.9 and roughness in 0.2 to 0.7, [count, 4]."""
    share = torch.rand(count, 4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.tensor([0.1, 0.1, 0.1, 0.2]) + share * torch.tensor([0.8, 0.8, 0.8, 0.5])


def test_prediction_is_the_published_image_formation_with_burleys_diffuse():
    samples, material = made_samples(200, 17), made_materials(200)
    light, cos, r = SHARED.light, samples.cos.numpy(), material[:, 3].numpy()
    strength = light.L0 * samples.log_cos_axis.exp().numpy() ** light.n
    strength /= samples.log_distance.exp().numpy() ** light.q
    grazing = 0.5 + 2 * r
    diffuse = material[:, :3].numpy() / np.pi * ((1 + (grazing - 1) * (1 - cos) ** 5) ** 2)[:, None]
    alpha2 = r**4
    peak = alpha2 / (np.pi * (cos**2 * (alpha2 - 1) + 1) ** 2)
    g1 = 2 / (1 + np.sqrt(1 + alpha2 * (1 / cos**2 - 1)))
    shine = SHARED.f0 * peak * g1**2 / (4 * cos**2)
    radiance = (diffuse + shine[:, None]) * (strength * cos * 2 * np.pi)[:, None]
    shown = predict(samples, material, SHARED).numpy()
    np.testing.assert_allclose(shown, radiance**SHARED.gamma, atol=0.003)
    assert 0.1 < np.median(shown) < 1


@pytest.mark.parametrize("scene", ["at the lens", "beside the lens in a tube"])
def test_a_coat_adds_its_lobe_and_its_derivative_is_the_central_difference(scene):
    samples, material = SCENES[scene](made_samples(300, 17)), made_materials(300)

    def coated(weight: float) -> Globals:
        return replace(shared_of(scene), coat=Coat(weight, 0.2))

    model = linearise(samples, material, coated(0.5))
    torch.testing.assert_close(
        model.predicted, predict(samples, material, coated(0.5)), rtol=1e-12, atol=1e-14
    )
    slope = (
        predict(samples, material, coated(0.5 + 1e-5)) - predict(samples, material, coated(0.5 - 1e-5))
    ) / 2e-5
    torch.testing.assert_close(model.by_coat, slope, rtol=1e-6, atol=1e-8)
    assert (slope > 0).all()
    bare = predict(samples, material, shared_of(scene))
    torch.testing.assert_close(predict(samples, material, coated(0.0)), bare, rtol=1e-12, atol=1e-14)


def beside_the_lens(samples: Samples) -> Samples:
    """The samples lit by two guides instead, and exposed unevenly."""
    generator = torch.Generator().manual_seed(5)

    def uniform(low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand(len(samples), 2, generator=generator, dtype=torch.float64)

    guides = Guided(
        cos_i=uniform(0, 0.99),
        sin2_m=uniform(1e-3, 0.9),
        cos_d=uniform(0.98, 1),
        log_axis=uniform(0.5, 1).log(),
        log_distance=uniform(6, 40).log(),
    )
    return replace(samples, guides=guides, log_exposure=uniform(-0.3, 0.3)[:, 0])


def in_a_tube(samples: Samples) -> Samples:
    """The samples lit by other tissue too."""
    generator = torch.Generator().manual_seed(6)

    def uniform(low: float, high: float, *shape: int) -> torch.Tensor:
        return low + (high - low) * torch.rand(len(samples), *shape, generator=generator, dtype=torch.float64)

    bounce = Bounce(
        log=uniform(-3, -1, 3),
        by_n=uniform(-0.5, 0),
        by_q=uniform(-4, -2),
        by_scale=uniform(1, 2, 3),
        by_gamma=uniform(1, 4, 3),
        gloss=torch.stack([uniform(0, 0.1), uniform(0.8, 1)], dim=1),
    )
    return replace(samples, bounce=bounce)


def following(samples: Samples) -> Samples:
    """The same samples, lit by tissue of ``made_materials`` and brighter as that gets brighter."""
    shown = SHARED.gamma * made_materials(len(samples))[:, :3].log()
    return replace(samples, bounce=replace(samples.bounce, shown=shown))


def shining(samples: Samples) -> Samples:
    """The same samples, lit by tissue that shines the more, as they do, the more f0 is."""
    generator = torch.Generator().manual_seed(8)
    by_f0, gloss = torch.rand(2, len(samples), generator=generator, dtype=torch.float64)
    bounce = samples.bounce.beside_lobe(0.04, 0.1, torch.tensor([0.05, 0.1, 0.2]).double(), gloss)
    return replace(samples, bounce=replace(bounce, by_f0=by_f0[:, None] * bounce.by_f0))


def behind_a_lens(samples: Samples) -> Samples:
    """The same samples, seen through a lens that vignettes."""
    generator = torch.Generator().manual_seed(7)
    return replace(samples, radius2=1.4 * torch.rand(len(samples), generator=generator, dtype=torch.float64))


SCENES = {
    "at the lens": lambda samples: samples,
    "beside the lens": beside_the_lens,
    "in a tube": in_a_tube,
    "beside the lens in a tube": lambda samples: in_a_tube(beside_the_lens(samples)),
    "in a tube whose light follows its colours": lambda samples: following(in_a_tube(samples)),
    "in a tube whose light follows its lobe": lambda samples: shining(in_a_tube(samples)),
    "behind a lens": behind_a_lens,
    "beside the lens in a tube behind it": lambda samples: behind_a_lens(in_a_tube(beside_the_lens(samples))),
    "toned": lambda samples: samples,
    "in a tube behind a lens, toned": lambda samples: behind_a_lens(in_a_tube(samples)),
}
BOUNCE_SHARED = Globals(torch.cat([SHARED.vector, torch.tensor([0.1], dtype=torch.float64)]))


def shared_of(scene: str) -> Globals:
    shared = BOUNCE_SHARED if "tube" in scene else SHARED
    shared = shared.behind(Vignetting(-0.4)) if "behind" in scene else shared
    return shared.under(Tone(0.4)) if "toned" in scene else shared


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("channel", range(4))
def test_derivative_by_material_is_the_central_difference(channel, scene):
    samples, material = SCENES[scene](made_samples(300, 17)), made_materials(300)
    shared = shared_of(scene)
    model = linearise(samples, material, shared)
    step = torch.zeros(4, dtype=torch.float64)
    step[channel] = 1e-6
    slope = (predict(samples, material + step, shared) - predict(samples, material - step, shared)) / 2e-6
    expected = model.by_roughness if channel == 3 else torch.zeros(300, 3, dtype=torch.float64)
    if channel < 3:
        expected[:, channel] = model.by_color[:, channel]
    torch.testing.assert_close(slope, expected, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(model.predicted, predict(samples, material, shared), rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize(
    "scene, index",
    [
        pytest.param(scene, index, id=f"{scene}-{EVERY_GLOBAL[place]}")
        for scene in SCENES
        for index, place in enumerate(shared_of(scene).places)
    ],
)
def test_derivative_by_a_shared_parameter_is_the_central_difference_at_the_displayed_color(scene, index):
    """What is fitted is b^γ: as γ moves, b moves with it."""
    samples, material, shared = SCENES[scene](made_samples(300, 17)), made_materials(300), shared_of(scene)
    step = torch.zeros(len(shared.vector), dtype=torch.float64)
    step[index] = 1e-6

    def shown(vector: torch.Tensor) -> torch.Tensor:
        moved = replace(shared, vector=vector)
        color = material[:, :3] ** (shared.gamma / moved.gamma)
        return predict(samples, torch.cat([color, material[:, 3:]], dim=1), moved)

    slope = (shown(shared.vector + step) - shown(shared.vector - step)) / 2e-6
    torch.testing.assert_close(
        slope, linearise(samples, material, shared).by_globals[..., index], rtol=1e-6, atol=1e-8
    )


def test_derivatives_are_finite_where_light_and_color_vanish():
    samples, material = single(made_samples(4, 1)), made_materials(4).float()
    material[:, :3] = 1e-3
    samples.cos[:], samples.sin2[:] = 1e-4, 1.0
    samples.log_distance[:], samples.log_cos_axis[:] = np.log(200.0), np.log(1e-4)
    for value in vars(linearise(samples, material, SHARED)).values():
        assert value is None or torch.isfinite(value).all()


def test_a_lens_is_one_parameter_more_before_the_albedos_scale_and_can_be_taken_off_again():
    for bare in (SHARED, BOUNCE_SHARED):
        behind = bare.behind(Vignetting(-0.4))
        assert behind.k2 == pytest.approx(-0.4) and behind.behind(Vignetting(-0.2)).k2 == pytest.approx(-0.2)
        assert (behind.bounces, behind.log_scale, behind.light) == (bare.bounces, bare.log_scale, bare.light)
        names = [EVERY_GLOBAL[place] for place in behind.places]
        assert len(names) == len(behind.vector) and "gamma·k2" in names
        assert ("ln albedo scale" in names) == bare.bounces
        assert torch.equal(behind.behind(None).vector, bare.vector) and bare.k2 == 0
        assert behind.without_scale().k2 == behind.k2 and not behind.without_scale().bounces


def test_a_curve_is_one_parameter_more_after_the_lens_and_can_be_taken_off_again():
    for bare in (
        SHARED,
        BOUNCE_SHARED,
        SHARED.behind(Vignetting(-0.4)),
        BOUNCE_SHARED.behind(Vignetting(-0.4)),
    ):
        toned = bare.under(Tone(0.4))
        assert toned.tone == Tone(0.4) and toned.under(Tone(0.2)).tone == Tone(0.2) and bare.tone is None
        assert (toned.bounces, toned.log_scale, toned.light) == (bare.bounces, bare.log_scale, bare.light)
        assert toned.k2 == pytest.approx(bare.k2) and "contrast" in [
            EVERY_GLOBAL[place] for place in toned.places
        ]
        assert torch.allclose(toned.under(None).vector, bare.vector)
        assert toned.without_scale().tone == toned.tone and not toned.without_scale().bounces


def test_globals_give_back_the_light_and_response_they_were_made_of():
    light = SHARED.light
    assert (light.L0, light.n, light.q) == pytest.approx((90.0, 1.8, 2.1))
    assert (SHARED.gamma, SHARED.f0) == pytest.approx((0.43, 0.05))


def test_a_clipped_photo_says_at_least():
    samples = made_samples(2, 1)
    samples.color[:] = torch.tensor([[255, 255, 100], [255, 100, 100]], dtype=torch.uint8)
    predicted = torch.tensor([[1.7, 0.9, 1.7], [1.0001, 100 / 255, 0.1]], dtype=torch.float64)
    residual = Residual.of(samples, predicted, WIDTH)
    assert residual.error[0, 0] == residual.weight[0, 0] == residual.error[1, 0] == residual.weight[1, 0] == 0
    assert residual.error[0, 1] == pytest.approx(0.1) and residual.weight[0, 1] > 0
    assert residual.error[0, 2] == pytest.approx(100 / 255 - 1.7)
    assert residual.weight[1, 1] == pytest.approx(1)


def test_the_weights_are_those_whose_weighted_error_is_the_slope_of_the_robust_cost():
    samples = made_samples(50, 1)
    predicted = torch.rand(50, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    residual = Residual.of(samples, predicted, WIDTH)
    for index in ((0, 0), (7, 1), (20, 2), (33, 0)):
        step = torch.zeros_like(predicted)
        step[index] = 1e-6
        slope = robust_cost(samples, predicted + step, WIDTH) - robust_cost(samples, predicted - step, WIDTH)
        expected = -(residual.weight * residual.error)[index]
        assert slope / 2e-6 == pytest.approx(float(expected), rel=1e-4, abs=1e-7)


@pytest.fixture(scope="module")
def dense(triangles):
    """Samples, materials, J [3N, 4·V] by told vertex and channel, dC/dGLOBALS [3N, 5], weight, error [3N]."""
    samples, materials = made_samples(400, len(triangles) - 1), made_materials(16)
    model = linearise(samples, at_pixels(samples, torch.from_numpy(triangles), materials), SHARED)
    residual = Residual.of(samples, model.predicted, WIDTH)
    J = np.zeros((400, 3, 16, 4))
    for sample, (triangle, weights) in enumerate(zip(samples.triangle, samples.barycentric, strict=True)):
        for vertex, weight in zip(triangles[triangle], weights, strict=True):
            for c in range(3):
                J[sample, c, vertex, c] += weight * model.by_color[sample, c]
                J[sample, c, vertex, 3] += weight * model.by_roughness[sample, c]
    flat = [x.numpy().reshape(1200, -1) for x in (model.by_globals, residual.weight, residual.error)]
    return samples, materials, J[:, :, np.unique(triangles[:-1])].reshape(1200, -1), *flat


@pytest.fixture(scope="module")
def equations(triangles, dense):
    samples, materials = single(dense[0]), dense[1].float()
    pattern = MeshPattern(samples, triangles, 16)
    return assemble(samples, pattern, torch.from_numpy(triangles), materials, SHARED, WIDTH)


def close(got, expected) -> None:
    np.testing.assert_allclose(got, expected, rtol=1e-3, atol=2e-5 * np.abs(expected).max())


def test_products_with_the_normal_equations_are_those_of_the_dense_matrix(equations, dense):
    _, _, J, _, weight, _ = dense
    values = np.random.default_rng(4).normal(size=(J.shape[1] // 4, 4, 3))
    got = equations @ torch.from_numpy(values).float()
    close(got.numpy().reshape(-1, 3), J.T @ (weight * (J @ values.reshape(-1, 3))))


def test_right_hand_sides_and_shared_blocks_are_the_dense_ones(equations, dense):
    _, _, J, by_globals, weight, error = dense
    against = np.concatenate([error, by_globals], axis=1)
    close(equations.right.numpy().reshape(-1, 6), J.T @ (weight * against))
    close(equations.shared, by_globals.T @ (weight * by_globals))
    close(equations.shared_right, (by_globals.T @ (weight * error))[:, 0])


def test_assembling_in_chunks_changes_nothing(equations, dense, triangles, monkeypatch):
    monkeypatch.setattr("endotwin.fit.normal_equations.CHUNK", 37)
    samples = single(dense[0])
    pattern = MeshPattern(samples, triangles, 16)
    again = assemble(samples, pattern, torch.from_numpy(triangles), dense[1].float(), SHARED, WIDTH)
    close(again.right.numpy(), equations.right.numpy())
    close(again.matrix.to_dense().numpy(), equations.matrix.to_dense().numpy())


@pytest.mark.parametrize("sin2", [DIFFUSE_SIN2 - 0.01, DIFFUSE_SIN2 + 0.01])
def test_beside_bounced_light_only_highlights_tell_roughness(dense, triangles, sin2):
    samples = replace(dense[0], sin2=torch.full_like(dense[0].sin2, sin2))
    bounce = in_a_tube(samples).bounce
    columns = {name: x.float() for name, x in vars(bounce).items() if x is not None}
    samples = replace(single(samples), bounce=Bounce(**columns))
    pattern = MeshPattern(samples, triangles, 16)
    equations = assemble(
        samples, pattern, torch.from_numpy(triangles), dense[1].float(), BOUNCE_SHARED, WIDTH
    )
    by_channel = equations.matrix.to_dense().unflatten(0, (-1, 4)).unflatten(2, (-1, 4))
    told = bool(by_channel[:, 3].any()), bool(equations.right[:, 3].any())
    assert told == (sin2 < DIFFUSE_SIN2,) * 2
    assert by_channel[:, 0].any()


def test_only_vertices_that_samples_tell_of_have_rows(triangles, dense):
    pattern = MeshPattern(dense[0], triangles, 20)
    assert pattern.told.numpy().nonzero()[0].tolist() == pattern.vertices.tolist()
    assert pattern.vertices.tolist() == np.unique(triangles[dense[0].triangle]).tolist() != list(range(20))
    np.testing.assert_array_equal(
        pattern.vertices[pattern.corners[pattern.compact]], triangles[dense[0].triangle]
    )


def test_lumped_blocks_are_the_row_sums_of_each_pair_of_channels(equations, dense):
    _, _, J, _, weight, _ = dense
    normal = (J.T @ (weight * J)).reshape(J.shape[1] // 4, 4, -1, 4)
    close(equations.lumped().numpy(), normal.sum(axis=2))


def test_conjugate_gradients_solve_all_right_hand_sides_as_a_dense_solver_does():
    generator = np.random.default_rng(5)
    blocks, channels = 30, 4
    size = blocks * channels
    factor = generator.normal(size=(size, size)) / np.sqrt(size)
    scale = np.exp(generator.uniform(-4, 4, blocks)).repeat(channels)
    matrix = scale[:, None] * (20 * factor @ factor.T + np.eye(size)) * scale
    right = generator.normal(size=(blocks, channels, 3)) * scale.reshape(blocks, channels, 1)
    diagonal = matrix.reshape(blocks, channels, blocks, channels)[range(blocks), :, range(blocks)]
    as_tensor = torch.from_numpy(matrix)
    products = []

    def product(x: torch.Tensor) -> torch.Tensor:
        products.append(x)
        return (as_tensor @ x.reshape(size, -1)).reshape(x.shape)

    equations = product, torch.from_numpy(right), torch.from_numpy(np.linalg.inv(diagonal))
    exact = np.linalg.solve(matrix, right.reshape(size, 3))

    def error(solved: torch.Tensor) -> float:
        left = solved.numpy().reshape(size, 3) - exact
        energy = (left * (matrix @ left)).sum(axis=0) / (exact * (matrix @ exact)).sum(axis=0)
        return float(np.sqrt(energy.max()))

    solved, image = conjugate_gradients(*equations)
    assert error(solved) < 5e-3
    close(image.numpy().reshape(size, 3), matrix @ solved.numpy().reshape(size, 3))
    cold = len(products)
    about = torch.from_numpy(3 * exact.reshape(right.shape) * generator.uniform(0.99, 1.01, right.shape))
    warm, _ = conjugate_gradients(*equations, start=about)
    assert error(warm) < 5e-3
    assert len(products) - cold < cold / 2


def test_the_joint_step_with_exact_solutions_is_the_solution_of_the_bordered_system():
    generator = np.random.default_rng(6)
    whole = generator.normal(size=(45, 45))
    whole = whole @ whole.T + np.eye(45)
    inner, border, shared = whole[:40, :40], whole[:40, 40:], whole[40:, 40:]
    residual, shared_residual = generator.normal(size=40), generator.normal(size=5)
    # The bordering block enters the equations with the sign of J: rows [A B; Bᵀ S].
    right = np.concatenate([residual[:, None], border], axis=1)
    basis = np.linalg.solve(inner, right)
    shaped = [torch.from_numpy(x.reshape(10, 4, 6)) for x in (basis, inner @ basis, right)]
    weights, shared_step, covariance = joint_minimum(*shaped, shared, shared_residual)
    exact = np.linalg.solve(whole, np.r_[residual, shared_residual])
    np.testing.assert_allclose(shared_step, exact[40:], rtol=1e-6)
    np.testing.assert_allclose(covariance, np.linalg.inv(whole)[40:, 40:], rtol=1e-6)
    np.testing.assert_allclose(basis @ weights, exact[:40], rtol=1e-5, atol=1e-7)


def test_pixels_beside_a_jump_of_depth_or_a_hole_are_discontinuities():
    depth_mm = np.full((9, 12), 20, np.float32)
    depth_mm += 0.05 * np.arange(12, dtype=np.float32)
    depth_mm[:, 6:] += 10
    depth_mm[1, 1] = np.nan
    expected = np.zeros((9, 12), bool)
    expected[:, 5:7] = True
    expected[:3, :3] = True
    np.testing.assert_array_equal(discontinuities(depth_mm), expected)


def test_of_pixels_without_depth_only_those_beside_some_are_discontinuities():
    depth_mm = np.full((9, 12), np.nan, np.float32)
    depth_mm[:, 8:] = 20
    expected = np.zeros((9, 12), bool)
    expected[:, 7:9] = True
    np.testing.assert_array_equal(discontinuities(depth_mm), expected)
    np.testing.assert_array_equal(discontinuities(np.nan_to_num(depth_mm)), expected)

"""Gains of frames eliminated from a step: against the dense system that holds them all."""

import numpy as np
import pytest
import test_model
import torch
from test_model import SHARED, WIDTH, close

from endotwin.fit.frame_gains import FramePattern
from endotwin.fit.mesh_pattern import MeshPattern
from endotwin.fit.model import at_pixels, linearise
from endotwin.fit.normal_equations import Residual, assemble

FRAMES, VERTICES = 5, 16
TOLD = 14
"""Vertices: the last triangle is in no photo."""


@pytest.fixture(scope="module")
def triangles() -> np.ndarray:
    return np.array([[0, 1, 2], [1, 3, 2], [4, 5, 6], [6, 5, 7], [8, 9, 10], [11, 12, 13], [13, 14, 15]])


@pytest.fixture(scope="module")
def dense(triangles):
    """Samples, materials, row of each sample's frame, J [3N, 4·TOLD + 5 + F] by materials, shared parameters
    and gains, robust weight [3N] and error [3N]."""
    samples, materials = test_model.made_samples(300, len(triangles) - 1), test_model.made_materials(VERTICES)
    model = linearise(samples, at_pixels(samples, torch.from_numpy(triangles), materials), SHARED)
    residual = Residual.of(samples, model.predicted, WIDTH)
    row = np.random.default_rng(2).integers(0, FRAMES, 300)
    J = np.zeros((300, 3, VERTICES, 4))
    for sample, (triangle, weights) in enumerate(zip(samples.triangle, samples.barycentric, strict=True)):
        for vertex, weight in zip(triangles[triangle], weights, strict=True):
            for c in range(3):
                J[sample, c, vertex, c] += weight * model.by_color[sample, c]
                J[sample, c, vertex, 3] += weight * model.by_roughness[sample, c]
    by_gain = np.zeros((300, 3, FRAMES))
    by_gain[np.arange(300), :, row] = SHARED.gamma * model.by_globals[..., 0].numpy()
    whole = np.concatenate([J[:, :, :TOLD].reshape(300, 3, -1), model.by_globals.numpy(), by_gain], axis=2)
    flat = (residual.weight.numpy().ravel(), residual.error.numpy().ravel())
    return samples, materials, row, whole.reshape(900, -1), *flat


@pytest.fixture(scope="module")
def reduced(triangles, dense):
    samples, materials, row = test_model.single(dense[0]), dense[1].float(), dense[2]
    pattern = MeshPattern(samples, triangles, VERTICES)
    frames = FramePattern(pattern.corners[pattern.compact], row, TOLD, FRAMES)
    tensor = torch.from_numpy(triangles)
    return assemble(samples, pattern, tensor, materials, SHARED, WIDTH, frames=frames)


def test_the_slope_by_a_gain_is_the_central_difference(dense, triangles):
    samples, materials, row, J, _, _ = dense
    material = at_pixels(samples, torch.from_numpy(triangles), materials)
    for frame in range(FRAMES):
        step = torch.from_numpy(np.where(row == frame, 1e-6, 0.0))
        up, down = (
            test_model.predict(test_model.replace(samples, log_exposure=sign * step), material, SHARED)
            for sign in (1, -1)
        )
        np.testing.assert_allclose(
            J[:, -FRAMES + frame], (up - down).numpy().ravel() / 2e-6, rtol=1e-6, atol=1e-8
        )


def test_what_is_left_is_the_schur_complement_of_gains_that_sum_to_0(reduced, dense):
    _, _, _, J, weight, error = dense
    materials = 4 * TOLD
    free = np.linalg.svd(np.ones((1, FRAMES)))[2][1:].T
    kept, gains = J[:, :-FRAMES], J[:, -FRAMES:] @ free
    border, inner = kept.T @ (weight[:, None] * gains), gains.T @ (weight[:, None] * gains)
    taken = border @ np.linalg.solve(inner, np.c_[border.T, gains.T @ (weight * error)])
    normal = kept.T @ (weight[:, None] * kept) - taken[:, :-1]
    right = kept.T @ (weight * error) - taken[:, -1]
    values = np.random.default_rng(4).normal(size=(TOLD, 4, 2))
    got = (reduced @ torch.from_numpy(values).float()).numpy().reshape(materials, 2)
    close(got, normal[:materials, :materials] @ values.reshape(materials, 2))
    close(reduced.right[..., 0].numpy().ravel(), right[:materials])
    close(reduced.right[..., 1:].numpy().reshape(materials, -1), normal[:materials, materials:])
    close(reduced.shared, normal[materials:, materials:])
    close(reduced.shared_right, right[materials:])


def test_gains_follow_a_step_of_the_rest_to_where_they_cost_least(reduced, dense):
    _, _, _, J, weight, error = dense
    generator = np.random.default_rng(5)
    step = 0.01 * generator.normal(size=J.shape[1] - FRAMES)
    vertex = torch.from_numpy(step[: 4 * TOLD].reshape(TOLD, 4)).float()
    found = reduced.gains.step(vertex, step[4 * TOLD :])
    free = np.linalg.svd(np.ones((1, FRAMES)))[2][1:].T
    gains, left = J[:, -FRAMES:] @ free, error - J[:, :-FRAMES] @ step
    expected = free @ np.linalg.solve(gains.T @ (weight[:, None] * gains), gains.T @ (weight * left))
    close(found, expected)
    assert abs(found.sum()) < 1e-5

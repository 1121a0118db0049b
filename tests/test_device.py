"""What a GPU runs: the same numbers as on the CPU, and nothing left behind on the CPU.

Where there is no GPU, tensors without any memory tell the latter: they refuse to meet any other.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
import tube_twin

from endotwin.errors import OptionError
from endotwin.fit import endopbr, normal_equations
from endotwin.fit.gauss_newton import GaussNewton
from endotwin.fit.hashgrid import HashGrid, corner_slots, level_slots
from endotwin.fit.mesh_pattern import pairs_of
from endotwin.fit.model import linearise, predict
from endotwin.fit.normal_equations import add, each_product, summed_products
from endotwin.run import threads

NOWHERE = torch.device("meta")
GPU = torch.device("cuda" if torch.cuda.is_available() else "cpu")


@pytest.fixture(scope="module")
def photographed():
    """A twin of a tube, samples of two of its renderings, and the state of a fit that has found all of it."""
    twin = tube_twin.fitted(tube_twin.seen(tube_twin.surface(fold_mm=2.0)))
    samples = tube_twin.photographed(
        twin, tube_twin.CAMERA, np.stack([tube_twin.pose(0.3), tube_twin.pose(0.5)])
    )
    return twin, samples, tube_twin.state_of(twin)


def test_slots_of_all_levels_on_a_device_are_those_of_each_level():
    points = np.random.default_rng(0).uniform(-40, 40, (500, 3))
    cells = HashGrid(12.0, 0.3).cells_mm
    slots, weights = level_slots(torch.from_numpy(points).to(GPU), cells, 12)
    for level, cell_mm in enumerate(cells):
        slot, weight = corner_slots(points, cell_mm, 12)
        np.testing.assert_array_equal(slots[:, level].cpu(), slot + (level << 12))
        np.testing.assert_allclose(weights[:, level].cpu(), weight, atol=1e-6)


def test_products_are_summed_alike_by_index_and_by_sparse_matrix():
    generator = np.random.default_rng(1)
    ids = torch.from_numpy(np.sort(generator.integers(0, 50, 2000)))
    left, right = (torch.from_numpy(generator.normal(size=(2000, width))).float() for width in (6, 7))
    by_matrix, by_index = torch.zeros(50, 6, 7), torch.zeros(50, 6, 7, device=GPU)
    add(by_matrix, summed_products(ids, left, right))
    add(by_index, each_product(*(x.to(GPU) for x in (ids, left, right))))
    np.testing.assert_allclose(by_index.cpu(), by_matrix, atol=1e-4)


def test_the_published_field_trains_wholly_on_the_device():
    field = endopbr.Field(np.zeros(3), np.full(3, 40.0)).to(NOWHERE)
    shared = endopbr.SharedParameters(20.0).to(NOWHERE)
    count = endopbr.PIXELS_A_STEP
    names = ("cos", "sin2", "log_cos_axis", "log_distance")
    pixels = {name: torch.rand(count, device=NOWHERE) for name in names}
    pixels["points_mm"] = torch.rand(count, 3, device=NOWHERE, dtype=torch.float64)
    pixels["color"] = torch.zeros(count, 3, device=NOWHERE, dtype=torch.uint8)
    parameters = [*field.parameters(), *shared.parameters()]
    optimizer = torch.optim.Adam(parameters, lr=1e-2)
    endopbr._step(field, shared, optimizer, pixels)
    assert all(parameter.grad.device == NOWHERE for parameter in parameters)
    assert optimizer.state[field.table]["exp_avg"].device == NOWHERE
    with pytest.raises(RuntimeError, match="device"):  # as it would be if anything were left behind
        endopbr._step(field, shared, optimizer, pixels | {"cos": torch.rand(count)})


def test_model_and_its_derivatives_are_made_where_the_samples_are(photographed):
    _, samples, state = photographed
    far = samples.to(NOWHERE)
    material = torch.rand(len(samples), 4, device=NOWHERE)
    model = linearise(far, material, state.shared)
    assert {predict(far, material, state.shared).device, model.by_globals.device} == {NOWHERE}
    sums = torch.zeros(7, 6, 7, device=NOWHERE)
    ids = torch.zeros(len(samples), dtype=torch.int64, device=NOWHERE)
    add(sums, summed_products(ids, pairs_of(far.barycentric), torch.rand(len(samples), 7, device=NOWHERE)))
    assert far.to(NOWHERE) is far and samples.to(torch.device("cpu")) is samples


def test_a_step_as_a_gpu_sums_it_ends_where_that_of_the_cpu_does(photographed, monkeypatch):
    twin, samples, state = photographed
    darker = replace(state, mean=state.mean * 0.9)
    ends = []
    for products in (summed_products, each_product):
        monkeypatch.setattr(normal_equations, "summed_products", products)
        solver = GaussNewton(samples, twin.surface.triangles, state.operator, device=GPU)
        for joint in (False, True):
            moved, gain, _ = solver.step(darker, joint)
            assert gain > 0 and moved.table.device.type == "cpu"
            ends.append((moved.materials, moved.shared.vector, gain))
    for (materials, vector, gain), other in zip(ends[:2], ends[2:], strict=True):
        np.testing.assert_allclose(materials, other[0], atol=2e-3)
        np.testing.assert_allclose(vector, other[1], atol=1e-3)
        assert gain == pytest.approx(other[2], rel=1e-3)


def test_no_result_depends_on_a_device_that_is_not_there(monkeypatch):
    assert threads.device_of("cpu") == torch.device("cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert threads.device_of("auto") == torch.device("cpu")
    for name in ("cuda", "tpu"):
        with pytest.raises(OptionError):
            threads.device_of(name)


@pytest.mark.parametrize(("told", "count"), [("", 4), ("1", 1), ("3,2", 3), ("64", 4), ("many", 4)])
def test_threads_are_the_cores_that_there_are_and_what_openmp_is_told(monkeypatch, told, count):
    monkeypatch.setattr(threads, "cores", lambda: 4)
    monkeypatch.setenv("OMP_NUM_THREADS", told)
    assert threads._threads() == count

"""The sparse hash operator is Instant-NGP's gather, forward and backward."""

import numpy as np
import pytest
import torch

from endotwin.fit.hashgrid import HASH_ORIGIN, HashGrid, HashOperator, corner_slots

GRID = HashGrid(coarsest_mm=9.0, finest_mm=1.0, growth=1.7, log2_slots=9)
"""Few slots: the fine levels collide."""


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    return np.random.default_rng(0).uniform(-20, 20, (300, 3))


@pytest.fixture(scope="module")
def operator(points) -> HashOperator:
    return HashOperator.of(points, GRID)


def ngp_hash(corner: tuple[int, int, int], log2_slots: int) -> int:
    """Müller et al. 2022, eq. 4, in Python's unbounded integers, about endotwin's origin."""
    x, y, z = (coordinate - HASH_ORIGIN for coordinate in corner)
    return (x ^ (y * 2_654_435_761) ^ (z * 805_459_861)) % (1 << log2_slots)


def gathers(points: np.ndarray, operator: HashOperator) -> tuple[list[list[int]], list[list[float]]]:
    """Table rows and weights that each point gathers, one corner after another."""
    row_of = {pair: row for row, pair in enumerate(zip(operator.level, operator.slot, strict=True))}
    rows, weights = [], []
    for point in points:
        rows.append([])
        weights.append([])
        for level, cell_mm in enumerate(operator.cells_mm):
            low = [int(np.floor(x / cell_mm)) for x in point]
            share = [x / cell_mm - base for x, base in zip(point, low, strict=True)]
            for bits in range(8):
                up = [(bits >> axis) & 1 for axis in range(3)]
                corner = tuple(base + bit for base, bit in zip(low, up, strict=True))
                rows[-1].append(row_of[level, ngp_hash(corner, GRID.log2_slots)])
                weights[-1].append(np.prod([s if bit else 1 - s for s, bit in zip(share, up, strict=True)]))
    return rows, weights


def random_table(operator: HashOperator, channels: int = 3) -> np.ndarray:
    return np.random.default_rng(1).normal(size=(len(operator.slot), channels)).astype(np.float32)


def test_features_equal_a_plain_gather_at_every_corner(points, operator):
    table = random_table(operator)
    rows, weights = gathers(points, operator)
    expected = np.einsum("nk,nkc->nc", weights, table.astype(np.float64)[np.array(rows)])
    np.testing.assert_allclose(operator(torch.from_numpy(table)).numpy(), expected, atol=5e-6)


def test_the_adjoint_scatters_as_index_add_does(points, operator):
    arriving = torch.randn(len(points), 3, generator=torch.Generator().manual_seed(2))
    rows, weights = (torch.tensor(np.array(part)) for part in gathers(points, operator))
    expected = torch.zeros(len(operator.slot), 3, dtype=torch.float64)
    spread = weights[..., None] * arriving.double()[:, None]
    expected.index_add_(0, rows.reshape(-1), spread.reshape(-1, 3))
    np.testing.assert_allclose((operator.adjoint_csr @ arriving).numpy(), expected.numpy(), atol=2e-5)


def test_weights_are_not_negative_and_sum_to_one_at_each_level(points, operator):
    for cell_mm in operator.cells_mm:
        slot, weight = corner_slots(points, cell_mm, GRID.log2_slots)
        assert weight.min() >= 0 and slot.min() >= 0 and slot.max() < 1 << GRID.log2_slots
        np.testing.assert_allclose(weight.sum(axis=1), 1, rtol=1e-12)
    ones = operator(torch.ones(len(operator.slot), 1))
    np.testing.assert_allclose(ones.numpy(), len(operator.cells_mm), rtol=1e-5)


def test_a_level_without_collisions_reproduces_a_linear_field(points):
    cell_mm, log2_slots = 8.0, 19
    operator = HashOperator.of(points, HashGrid(cell_mm, cell_mm, log2_slots=log2_slots))
    corners = np.unique(
        np.concatenate([np.floor(points / cell_mm) + np.array(corner) for corner in np.ndindex(2, 2, 2)]),
        axis=0,
    ).astype(int)
    slots = np.array([ngp_hash(tuple(corner.tolist()), log2_slots) for corner in corners])
    assert len(np.unique(slots)) == len(slots) == len(operator.slot)
    slope, offset = np.array([0.3, -0.7, 0.2]), 1.5
    table = np.zeros((len(slots), 1), np.float32)
    table[np.searchsorted(operator.slot, slots), 0] = corners * cell_mm @ slope + offset
    np.testing.assert_allclose(
        operator(torch.from_numpy(table)).numpy()[:, 0], points @ slope + offset, atol=1e-5
    )


def test_corners_about_the_origin_collide_no_more_than_by_chance():
    """A hash of signed coordinates about 0 would give mirror images one slot, half of these corners."""
    sphere = np.random.default_rng(3).normal(size=(20_000, 3))
    sphere *= 60 / np.linalg.norm(sphere, axis=1, keepdims=True)
    for cell_mm in (12.0, 6.0, 3.0, 1.6):
        low = np.floor(sphere / cell_mm)[:, None] + np.array(list(np.ndindex(2, 2, 2)))
        corners = len(np.unique(low.reshape(-1, 3), axis=0))
        slots = len(np.unique(corner_slots(sphere, cell_mm, 19)[0]))
        by_chance = 2**19 * -np.expm1(-corners / 2**19)
        assert slots > by_chance - 5 * np.sqrt(corners - by_chance + 1)


def test_cells_shrink_by_the_growth_from_the_coarsest_to_no_less_than_the_finest():
    cells_mm = GRID.cells_mm
    assert cells_mm[0] == 9.0
    np.testing.assert_allclose(cells_mm[:-1] / cells_mm[1:], 1.7)
    assert 1.0 <= cells_mm[-1] < 1.7
    assert len(HashGrid(1.0, 5.0).cells_mm) == 1


def test_a_table_says_at_other_points_what_an_operator_of_theirs_would(points, operator):
    """Where both have a row; a corner that no fitted point touched counts as 0."""
    table = torch.from_numpy(random_table(operator))
    np.testing.assert_allclose(operator.at(points, table), operator(table), atol=1e-5)
    elsewhere = np.array([[1e4, 1e4, 1e4]])
    some = HashOperator.of(points[:1], GRID)
    assert some.at(points[:1], torch.from_numpy(random_table(some))).abs().max() > 0
    assert not HashOperator.of(points[:1], HashGrid(9.0, 9.0)).at(elsewhere, torch.ones(8, 3)).any()

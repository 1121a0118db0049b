"""What bounced light that follows all tissue adds to the normal equations, against the full matrix."""

import numpy as np
import pytest
import torch

from endotwin.fit.following import Following
from endotwin.light.bounced import WITH_ALL

ENTRIES, PIXELS = 7, 40


def full(values: np.ndarray) -> np.ndarray:
    """[R, 3] of a table's colours as columns of the whole table [R · 4, 3]: each channel has its own."""
    whole = np.zeros((ENTRIES, 4, 3))
    for channel in range(3):
        whole[:, channel, channel] = values[:, channel]
    return whole.reshape(-1, 3)


@pytest.mark.parametrize("kept", [None, 0, 2])
def test_products_and_pulls_are_those_of_slopes_that_know_what_every_entry_does_to_all_light(kept):
    random = np.random.default_rng(3)
    slopes, by_light = random.normal(size=(PIXELS, ENTRIES * 4)), random.normal(size=(PIXELS, 3))
    weight, error, along = (
        random.uniform(0.5, 2, PIXELS),
        random.normal(size=PIXELS),
        random.normal(size=(7, 3)),
    )
    turn = WITH_ALL * np.eye(3) - (0 if kept is None else np.outer(np.ones(3), np.eye(3)[kept]))
    whole = slopes + by_light @ turn @ full(along).T
    weighted = by_light.T * weight
    border = (weighted @ slopes).T.reshape(ENTRIES, 4, 3)
    following = Following(
        torch.from_numpy(along),
        Following.turning(kept).double(),
        torch.from_numpy(border),
        torch.from_numpy(weighted @ by_light),
    )
    step = random.normal(size=(ENTRIES, 4, 2))
    more = whole.T @ (weight[:, None] * (whole @ step.reshape(-1, 2))) - slopes.T @ (
        weight[:, None] * (slopes @ step.reshape(-1, 2))
    )
    found = following.product(torch.from_numpy(step)).numpy()
    np.testing.assert_allclose(found, more.reshape(step.shape), atol=1e-9)
    pulled = following.right(torch.from_numpy(weighted @ error)[:, None]).numpy()
    np.testing.assert_allclose(pulled.ravel(), (whole - slopes).T @ (weight * error), atol=1e-9)


@pytest.mark.parametrize("kept", [0, 1, 2])
def test_a_scale_that_makes_up_for_a_channel_leaves_its_light_to_what_is_about_each_place(kept):
    random = np.random.default_rng(kept)
    along = torch.from_numpy(random.normal(size=(ENTRIES, 3)))
    nothing = torch.zeros(ENTRIES, 4, 3, dtype=torch.float64), torch.zeros(3, 3, dtype=torch.float64)
    turn = Following.turning(kept).double()
    following = Following(along, turn, *nothing)
    whiter = following.whiter(torch.from_numpy(random.normal(size=(ENTRIES, 4, 1))))
    lit = (turn @ whiter)[:, 0] + whiter[kept]
    torch.testing.assert_close(lit, WITH_ALL * whiter[:, 0])

"""What the any-time fit allows itself, by the clock."""

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from endotwin.config import FitConfig
from endotwin.fit.light_stage import UNCACHED, Cost
from endotwin.pixels.pace import ITERATIONS, Pace, spread_order


@given(st.integers(1, 300))
def test_every_beginning_of_the_spread_order_is_evenly_spread(count):
    order = spread_order(count)
    assert sorted(order) == list(range(count))
    for some in (2, 4, 8, 16):
        if some < count:
            places = np.sort(order[:some])
            gaps = np.diff([*places, count])
            assert gaps.max() <= 2 * count / some + 1


def test_without_a_budget_everything_is_done_in_order():
    pace = Pace(FitConfig(pixels=1000))
    assert list(pace.photos([5, 3, 8])) == [5, 3, 8]
    assert pace.pixels == pace.start_pixels == 1000
    assert pace.share(frames=10, pixels=400) == pytest.approx(0.25)
    assert not pace.out_of_time() and not pace.light_is_over()


def test_a_budget_that_is_spent_still_reads_one_photo_and_then_nothing():
    pace = Pace(FitConfig(budget=1e-3))
    time.sleep(2e-3)
    assert len(list(pace.photos(list(range(50))))) == 1
    assert pace.out_of_time() and pace.light_is_over() and pace.left() == 0


def test_light_that_is_found_again_beside_a_tone_curve_has_time_of_its_own_and_leaves_some_for_the_detail():
    pace = Pace(FitConfig(budget=100))
    once = pace.light_left
    assert pace.find_light_again(took_s=60)
    assert not pace.find_light_again(took_s=80)
    assert once + 20 < pace.light_left < pace.left(ITERATIONS) - 10
    assert not pace.light_is_over()


def test_light_may_take_all_that_the_detail_leaves_of_a_budget_but_never_has_less_than_its_share():
    pace = Pace(FitConfig(budget=100))
    share = pace.light_left
    pace.leave(20)
    assert pace.light_left == pytest.approx(pace.left(ITERATIONS) - 20, abs=0.1)
    pace.leave(90)
    assert pace.light_left == pytest.approx(share, abs=1)


def test_light_has_a_third_of_what_is_left_even_where_its_share_is_used_up():
    pace = Pace(FitConfig(budget=0.5))
    time.sleep(0.21)
    assert pace.light_is_over()
    pace.leave(90)
    assert pace.light_left == pytest.approx(pace.left(ITERATIONS) / 3, abs=0.02)


def test_the_detail_costs_what_the_lights_step_did_by_its_weights_its_pixels_and_its_steps():
    cost = Cost(setup_s=1, step_s=5, solve_s=2, weights=10, pixels=100)
    assert cost.detail_s(weights=10, pixels=100, steps=1) == 1 + UNCACHED * 2 + 3
    assert cost.detail_s(weights=20, pixels=300, steps=2) == 2 * 1 + 2 * (2 * UNCACHED * 2 + 3 * 3)
    assert cost.least_s(weights=20) == cost.detail_s(weights=20, pixels=0, steps=1)


def test_pixels_grow_with_the_budget_up_to_those_of_the_plan():
    pixels = [Pace(FitConfig(budget=budget)).pixels for budget in (1, 5, 20, 1000)]
    assert pixels == sorted(pixels) and pixels[0] < pixels[1] < pixels[2] <= pixels[3] == FitConfig().pixels
    assert Pace(FitConfig(pixels=700, budget=1000)).pixels == 700

"""Which frames are fused: those that see something new, however many there are."""

import itertools

import numpy as np
import pytest
import tube_sequence

import endotwin
from endotwin import fusion
from endotwin.errors import OptionError
from endotwin.fusion import choice
from endotwin.fusion.agreement import Tolerance
from endotwin.fusion.choice import chosen, compared, cover, differing, glances
from endotwin.fusion.coverage import covered, covered_by_glances
from endotwin.fusion.views import read_views
from endotwin.sequence.readers import open_sequence
from endotwin.surface.casting import Caster


@pytest.fixture(scope="module")
def slow_flight(tmp_path_factory):
    """A tube whose every frame is there four times."""
    folder = tube_sequence.write(tmp_path_factory.mktemp("choice") / "tube", 8, 96, 72)
    for kind, suffix in (("color", "png"), ("depth", "tiff")):
        contents = [(folder / f"{index:04d}_{kind}.{suffix}").read_bytes() for index in range(8)]
        for index in range(32):
            (folder / f"{index:04d}_{kind}.{suffix}").write_bytes(contents[index // 4])
    lines = (folder / "pose.txt").read_text().splitlines()
    (folder / "pose.txt").write_text("\n".join(lines[index // 4] for index in range(32)) + "\n")
    return folder


def test_a_cover_holds_everything_and_is_near_the_smallest():
    generator = np.random.default_rng(0)
    for _ in range(20):
        sets = [np.unique(generator.integers(0, 12, 4)) for _ in range(8)]
        taken = cover(sets, 1)
        assert set(np.concatenate([sets[number] for number in taken])) == set(np.concatenate(sets))
        smallest = next(
            size
            for size in range(1, 9)
            for some in itertools.combinations(sets, size)
            if set(np.concatenate(some)) == set(np.concatenate(sets))
        )
        assert len(taken) <= smallest * sum(1 / k for k in range(1, 5))  # greedy's bound, H(4)


def test_a_cover_stops_where_the_best_of_the_rest_adds_too_little_and_may_hold_all_twice():
    sets = [np.arange(10), np.arange(5, 12), np.array([20]), np.arange(10)]
    assert cover(sets, 2) == [0, 1]
    assert cover(sets, 1) == [0, 1, 2]
    assert sorted(cover(sets, 1, fold=2)) == [0, 1, 2, 3]


def test_a_frame_that_repeats_another_is_never_chosen(slow_flight):
    sequence = open_sequence(slow_flight)
    taken = chosen(sequence.camera, glances(sequence, range(32)))
    assert len({index // 4 for index in taken}) == len(taken) <= 8
    twice = chosen(sequence.camera, glances(sequence, range(32)), fold=2)
    assert len(taken) < len(twice) <= 16


def test_what_is_fused_is_in_the_record_and_agrees_with_all_frames_nearly_as_well(slow_flight, monkeypatch):
    every = endotwin.fuse_twin(slow_flight)
    assert (len(every.record["fuse"]["fused"]), every.record["fuse"]["nothing_new"]) == (32, 0)
    monkeypatch.setattr(fusion, "WORTH_PIXELS", 0)
    some = endotwin.fuse_twin(slow_flight)
    made = some.record["fuse"]
    assert len(made["fused"]) <= 12 and made["nothing_new"] == 32 - len(made["fused"])
    sequence = some.sequence()
    seen = glances(sequence, range(32))
    tolerance = Tolerance(0.1, 0.01)
    agree = [
        np.mean(list(compared(sequence.camera, Caster(twin.surface), seen, tolerance)[0].values()))
        for twin in (every, some)
    ]
    assert agree[1] > agree[0] - 0.005
    assert (some.surface.seen_by > 0).mean() > (every.surface.seen_by > 0).mean() - 0.01


def test_a_frame_in_which_the_surface_lacks_something_is_patched_from(slow_flight):
    sequence = open_sequence(slow_flight)
    surface = endotwin.fuse_twin(slow_flight).surface
    gone = np.linalg.norm(surface.vertices_mm - surface.vertices_mm[0], axis=1) < 4.0
    torn = surface.__class__(
        **{**vars(surface), "triangles": surface.triangles[~gone[surface.triangles].any(axis=1)]}
    )
    seen = glances(sequence, range(32))
    tolerance = Tolerance(0.1, 0.01)
    _, whole = compared(sequence.camera, Caster(surface), seen, tolerance)
    shares, places = compared(sequence.camera, Caster(torn), seen, tolerance)
    least = choice.LEAST_LACKING
    blind = [index for index in places if len(places[index]) < len(whole[index]) + least]
    assert 0 < len(blind) < 32
    new = {index: len(np.setdiff1d(places[index], places[blind[0]])) for index in places}
    asked = differing(places, blind[:1])
    assert asked[0] not in blind
    assert new[asked[0]] == max(new.values())
    assert all(new[index] >= least for index in asked)
    assert min(shares.values()) < 1


def test_vertices_that_only_a_glance_saw_count_as_seen(slow_flight):
    sequence = open_sequence(slow_flight)
    surface = endotwin.fuse_twin(slow_flight).surface
    tolerance, lens_mask = Tolerance(0.3, 0.01), sequence.lens_mask
    one, every = ([1], [1, 5, 9, 29])
    exact = covered(sequence.camera, surface, read_views(sequence, every), lens_mask, tolerance)
    first = covered(sequence.camera, surface, read_views(sequence, one), lens_mask, tolerance)
    rest = covered_by_glances(sequence.camera, first, glances(sequence, every[1:]), lens_mask, tolerance)
    assert (first.seen_by > 0).mean() < (exact.seen_by > 0).mean() - 0.05
    assert ((rest.seen_by > 0) == (exact.seen_by > 0)).mean() > 0.98


def test_many_pixels_are_what_makes_frames_chosen(slow_flight, monkeypatch):
    monkeypatch.setattr(fusion, "WORTH_PIXELS", 32 * 96 * 72)
    assert choice.WORTH_PIXELS > 32 * 96 * 72
    assert endotwin.fuse_twin(slow_flight).record["fuse"]["nothing_new"] == 0


def test_a_voxel_that_needs_more_memory_than_there_may_be_is_refused(slow_flight):
    with pytest.raises(OptionError, match="more than 2 GB"):
        endotwin.fuse_twin(slow_flight, voxel_mm=0.001)

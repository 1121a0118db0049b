"""Automatic gain: what it wants, how it lags, and that it is the same in every worker."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tube_twin

import endotwin
import endotwin.synth
from endotwin.effects import Effect, Effects
from endotwin.effects.auto_gain import AutoGain
from endotwin.effects.exposures import Exposures
from endotwin.effects.noise import Noise
from endotwin.sequence import Sequence
from endotwin.sequence.readers import open_sequence
from endotwin.synth.trajectories.trajectory import Trajectory

GAMMA = 1 / 2.2


@pytest.fixture(scope="module")
def twin() -> endotwin.Twin:
    return tube_twin.fitted(tube_twin.seen(tube_twin.surface(fold_mm=1.5)))


def test_the_wanted_gain_brings_a_picture_to_the_target_within_its_range():
    x = np.random.default_rng(0).uniform(0.001, 0.05, 1000)
    effect = AutoGain(target=0.3, range=50)
    gain = effect.wanted((x**GAMMA).mean(), GAMMA)
    assert ((gain * x) ** GAMMA).mean() == pytest.approx(0.3)
    assert AutoGain(range=3.0).wanted(0.0, GAMMA) == 3.0
    assert AutoGain(range=4.0).wanted(1e3, GAMMA) == 0.25


def test_it_comes_nearer_by_e_in_its_lag_whatever_the_steps():
    effect, gain = AutoGain(lag=0.5), 4.0
    assert np.log(effect.next(4.0, 1.0, 0.5)) == pytest.approx(np.log(4.0) / np.e)
    for _ in range(10):
        gain = effect.next(gain, 1.0, 0.05)
    assert gain == pytest.approx(effect.next(4.0, 1.0, 0.5))
    assert AutoGain(lag=0.0).next(4.0, 1.0, 1e-3) == 1.0


def flight(twin: endotwin.Twin, count: int = 40) -> Trajectory:
    """Forward, then with the lens near to the wall at once."""
    places = np.where(np.arange(count) < count // 2, 0.4, 0.7)
    return Trajectory(np.stack([tube_twin.pose(s) for s in places]), np.arange(count) / 30, "a jump")


def rendered(twin: endotwin.Twin, folder, workers: int = 1, **parameters) -> tuple[np.ndarray, np.ndarray]:
    """Gains, and the mean display values of the pictures."""
    equipped = replace(twin, effects=Effects([AutoGain(**parameters)]))
    labels = ("rgb", "depth", "diffuse", "specular", "rgb_exr")
    endotwin.synth.synthesize(equipped, flight(twin), folder, labels=labels, workers=workers)
    records = [json.loads(line) for line in (folder / "frames.jsonl").read_text().splitlines()]
    levels = [cv2.imread(str(file)).mean() / 255 for file in sorted(folder.glob("*_color.png"))]
    return np.array([record["gain"] for record in records]), np.array(levels)


def test_pictures_reach_the_target_and_a_change_is_followed_late(twin, tmp_path):
    gains, levels = rendered(twin, tmp_path / "quick", target=0.3, lag=0.0, range=100.0)
    np.testing.assert_allclose(levels, 0.3, atol=0.02)
    lagging, _ = rendered(twin, tmp_path / "slow", target=0.3, lag=0.2, range=100.0)
    assert lagging[0] == pytest.approx(gains[0])
    change = np.log(gains[-1] / gains[0])
    assert abs(change) > 0.02
    left = np.log(gains[-1] / lagging[21:]) / change
    assert (np.diff(left) < 0).all() and 0.5 < left[0] < 1 and left[-1] < 0.1


def recording(twin: endotwin.Twin, folder: Path, *effects: Effect) -> Sequence:
    """A camera that nears the wall and leaves it, for four seconds, as a sequence of files."""
    times_s = np.arange(120) / 30
    poses = np.stack([tube_twin.pose(0.4 + 0.05 * t) for t in times_s])
    poses[:, 1, 3] += 8 * np.sin(2 * times_s)
    equipped = replace(twin, effects=Effects(effects))
    endotwin.synth.synthesize(
        equipped, Trajectory(poses, times_s, "side to side"), folder, labels=("rgb", "depth")
    )
    return open_sequence(folder)


@pytest.mark.parametrize("lag", [0.0, 0.1, 0.5])
def test_target_and_lag_put_in_come_out(twin, tmp_path, lag):
    found, _ = AutoGain.evidence(recording(twin, tmp_path / "held", AutoGain(0.35, lag, 100.0), Noise()))
    assert found.target == pytest.approx(0.35, abs=0.035)  # metering ten times a second waits, too
    assert found.lag == pytest.approx(lag, rel=0.25, abs=0.035)  # metering ten times a second waits, too


def test_a_camera_that_keeps_its_gain_tells_none(twin, tmp_path):
    sequence = recording(twin, tmp_path / "kept", Noise())
    assert AutoGain.evidence(sequence)[0] is None
    assert np.abs(Exposures.of(sequence, range(120)).log_change).max() < 0.01
    timeless = replace(sequence, timestamps_s=np.zeros(len(sequence)))
    assert AutoGain.evidence(timeless)[0] is None


@pytest.mark.parametrize(
    "kind, told",
    [("direct", False), ("gi", False), ("offset", False), ("bounce", False), ("scope", True), ("wet", True)],
)
def test_path_traced_colons_tell_an_automatic_gain_where_they_have_one(data_root, kind, told):
    folder = data_root / f"colon_{kind}"
    assert (AutoGain.evidence(open_sequence(folder))[0] is not None) == told


@pytest.mark.long
def test_it_is_the_same_with_two_workers_and_the_labels_hold(twin, tmp_path):
    one, two = tmp_path / "one", tmp_path / "two"
    rendered(twin, one), rendered(twin, two, workers=2)
    files = [file.relative_to(one) for file in one.rglob("*") if file.is_file()]
    assert all((one / file).read_bytes() == (two / file).read_bytes() for file in files)
    assert endotwin.synth.prove(one).holds

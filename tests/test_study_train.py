"""Training: losses in closed form, pools as one set, and a stopped run that goes on."""

import math

import numpy as np
import pytest
import torch

from endotwin.errors import OptionError
from endotwin.study.frames import Frames
from endotwin.study.networks import found, network
from endotwin.study.train import HUBER_MM, Course, batch, huber, predicted, silog, train

CPU = torch.device("cpu")
COURSE = Course(steps=6, batch=2, rate=1e-3, loss="huber", seed=3)


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def frames(count: int, color: int = 90, depth_mm: float = 30.0) -> Frames:
    generator = np.random.default_rng(count)
    noise = generator.integers(-40, 40, (count, 32, 40, 3))
    depths = depth_mm + generator.uniform(-5, 5, (count, 32, 40))
    depths[:, :4] = np.nan
    return Frames((color + noise).astype(np.uint8), depths.astype(np.float16), np.arange(count))


def known(depth_mm: torch.Tensor) -> torch.Tensor:
    return torch.isfinite(depth_mm)


def test_huber_is_quadratic_below_five_millimetres_and_linear_beyond():
    depth_mm = torch.tensor([30.0])
    assert huber(depth_mm + 3, depth_mm, known(depth_mm)).item() == pytest.approx(4.5)
    far = huber(depth_mm - 12, depth_mm, known(depth_mm)).item()
    assert far == pytest.approx(HUBER_MM * (12 - HUBER_MM / 2))


def test_silog_of_a_common_factor_is_its_logarithm_by_root_two():
    depth_mm = torch.linspace(5, 90, 50)
    twice = silog(2 * depth_mm, depth_mm, known(depth_mm)).item()
    assert twice == pytest.approx(math.log(2) / math.sqrt(2), rel=1e-5)
    assert silog(depth_mm, depth_mm, known(depth_mm)).item() == pytest.approx(0, abs=1e-5)


@pytest.mark.parametrize("loss", [huber, silog])
def test_pixels_without_depth_change_neither_loss_nor_slope(loss):
    depth_mm = torch.linspace(5, 90, 50)
    depth_mm[::3] = torch.nan
    has = known(depth_mm)
    predicted_mm = torch.full((50,), 40.0, requires_grad=True)
    some_mm = predicted_mm.detach()[has].requires_grad_()
    whole, part = loss(predicted_mm, depth_mm, has), loss(some_mm, depth_mm[has], has[has])
    whole.backward()
    part.backward()
    assert whole.item() == pytest.approx(part.item(), rel=1e-6)
    torch.testing.assert_close(predicted_mm.grad[has], some_mm.grad)
    assert not predicted_mm.grad[~has].any()


def test_each_frame_of_all_pools_is_as_likely():
    pools = [frames(5, color=60, depth_mm=20), frames(15, color=180, depth_mm=60)]
    course = Course(steps=1, batch=400, rate=1e-3, loss="huber", seed=0)
    color, depth_mm = batch(pools, course, step=0)
    assert color.shape == (400, 3, 32, 40) and depth_mm.shape == (400, 32, 40)
    bright = color.mean(dim=(1, 2, 3)) > 0.45
    assert bright.sum() == pytest.approx(300, abs=3 * (400 * 0.25 * 0.75) ** 0.5)
    assert (torch.nanmean(depth_mm[bright]) > 50) and (torch.nanmean(depth_mm[~bright]) < 30)


def test_flips_move_photo_and_depth_alike():
    depth_mm = np.arange(32 * 40, dtype=np.float32).reshape(1, 32, 40) / 20
    color = np.repeat((depth_mm * 3)[..., None], 3, axis=3).astype(np.uint8)
    pool = Frames(color, depth_mm.astype(np.float16), np.arange(1))
    seen = set()
    for step in range(20):
        photos, depths = batch([pool], COURSE, step)
        assert (photos[:, 0] * 255 - depths * 3).abs().max() < 1.2
        seen |= {float(each) for each in depths[:, 0, 0]}
    assert len(seen) == 4


def test_a_stopped_training_goes_on_to_the_same_weights(tmp_path, monkeypatch):
    monkeypatch.setattr("endotwin.study.train.CHECKPOINT_STEPS", 2)
    pools = [frames(5)]

    def trained(checkpoint, stop_at=None):
        def watch(done):
            if done == stop_at:
                raise KeyboardInterrupt

        return train(network("small", 3), pools, COURSE, checkpoint, watch, CPU)

    whole = trained(tmp_path / "whole.pt")
    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path / "parted.pt", stop_at=5)
    done = []
    parted = train(network("small", 3), pools, COURSE, tmp_path / "parted.pt", done.append, CPU)
    assert done == [5, 6]
    for one, other in zip(whole.parameters(), parted.parameters(), strict=True):
        assert torch.equal(one, other)


def test_a_checkpoint_of_another_course_is_not_heeded(tmp_path):
    train(network("small", 3), [frames(2)], COURSE, tmp_path / "c.pt", lambda _: None, CPU)
    other = Course(steps=2, batch=2, rate=1e-3, loss="silog", seed=3)
    done = []
    train(network("small", 3), [frames(2)], other, tmp_path / "c.pt", done.append, CPU)
    assert done == [1, 2]


def test_the_small_network_has_a_million_parameters_and_learns_a_constant_depth(tmp_path):
    small = network("small", 0)
    assert 0.8e6 < sum(each.numel() for each in small.parameters()) < 1.3e6
    pool = frames(6, depth_mm=50)
    before = np.abs(predicted(small.eval(), pool.color, CPU) - 50).mean()
    course = Course(steps=40, batch=2, rate=2e-3, loss="huber", seed=0)
    after = predicted(train(small, [pool], course, tmp_path / "c.pt", lambda _: None, CPU), pool.color, CPU)
    assert np.abs(after - 50).mean() < 0.3 * before


def test_the_depth_of_a_photo_does_not_depend_on_its_batch():
    small = network("small", 1).eval()
    torch.nn.init.normal_(small.head.weight, std=0.1)
    color = frames(3).color
    together = predicted(small, color, CPU)
    alone = np.concatenate([predicted(small, color[index : index + 1], CPU) for index in range(3)])
    assert together == pytest.approx(alone, rel=1e-4)


def test_without_weights_the_small_network_runs_with_a_word(monkeypatch, tmp_path, caplog):
    monkeypatch.setattr("endotwin.study.networks.WEIGHTS", str(tmp_path / "nowhere"))
    assert found("auto") == "small"
    assert "the small network runs" in caplog.text


@pytest.mark.parametrize("name", ["nowhere/at/all", "."])
def test_a_place_without_weights_is_refused_in_a_sentence(name):
    with pytest.raises(OptionError, match="weights of Depth Anything"):
        network(name, 0)

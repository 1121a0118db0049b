"""Depth Anything's architecture, tiny and with random weights, through transformers and peft."""

import numpy as np
import pytest
import torch
import tube_sequence

from endotwin.study import Plan, study_depth
from endotwin.study.depth_anything import DepthAnything
from endotwin.study.frames import Frames
from endotwin.study.networks import network
from endotwin.study.train import Course, predicted, train, trained_weights

pytestmark = pytest.mark.slow

CPU = torch.device("cpu")
LAYERS = 4


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A folder with weights of a tiny network for relative depth."""
    from transformers import DepthAnythingConfig, DepthAnythingForDepthEstimation, Dinov2Config

    torch.manual_seed(0)
    backbone = Dinov2Config(
        hidden_size=32,
        num_hidden_layers=LAYERS,
        num_attention_heads=2,
        mlp_ratio=2,
        image_size=56,
        patch_size=14,
        out_indices=[1, 2, 3, 4],
        reshape_hidden_states=False,
    )
    config = DepthAnythingConfig(
        backbone_config=backbone,
        reassemble_hidden_size=32,
        neck_hidden_sizes=[8, 8, 16, 16],
        fusion_hidden_size=8,
        head_hidden_size=8,
    )
    folder = tmp_path_factory.mktemp("weights")
    DepthAnythingForDepthEstimation(config).save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def pool(weights):
    width, height = DepthAnything(weights, adapted=True).size
    generator = np.random.default_rng(0)
    color = generator.integers(0, 255, (4, height, width, 3)).astype(np.uint8)
    return Frames(color, np.full((4, height, width), 40, np.float16), np.arange(4))


def test_lora_is_on_every_layer_of_attention_and_mlp_and_the_head_is_trained_whole(weights):
    names = set(trained_weights(network(str(weights), 0)))
    lora = {name for name in names if "lora_" in name}
    assert len(lora) == LAYERS * 6 * 2  # q, k, v, dense, fc1, fc2; two factors each
    assert all("head" in name for name in names - lora) and len(names - lora) == 6
    assert all(each.shape[0 if "lora_A" in name else 1] == 8 for name, each in lora_of(weights).items())


def lora_of(weights):
    return {name: each for name, each in trained_weights(network(str(weights), 0)).items() if "lora_" in name}


def test_before_training_lora_changes_nothing_of_the_backbone(weights, pool):
    adapted, plain = (DepthAnything(weights, adapted=each).eval() for each in (True, False))
    photos = torch.rand(2, 3, *pool.color.shape[1:3])
    with torch.inference_mode():
        features = adapted.model.base_model.model.backbone(photos).feature_maps[-1]
        assert torch.allclose(features, plain.model.backbone(photos).feature_maps[-1], atol=1e-6)


def test_it_predicts_metric_depth_below_100_mm_and_learns(weights, pool, tmp_path):
    adapted = network(str(weights), 0)
    before = predicted(adapted.eval(), pool.color, CPU)
    assert before.shape == pool.depth_mm.shape and (before >= 0).all() and (before <= 100).all()
    course = Course(steps=12, batch=2, rate=5e-3, loss="silog", seed=0)
    frozen = {name: each.clone() for name, each in adapted.named_parameters() if not each.requires_grad}
    trained = train(adapted, [pool], course, tmp_path / "c.pt", lambda _: None, CPU)
    after = predicted(trained, pool.color, CPU)
    assert np.abs(after - 40).mean() < np.abs(before - 40).mean()
    assert all(torch.equal(each, frozen[name]) for name, each in trained.named_parameters() if name in frozen)


def test_its_checkpoint_holds_only_what_was_trained_and_gives_the_same_network(weights, pool, tmp_path):
    course = Course(steps=2, batch=2, rate=1e-3, loss="huber", seed=1)
    trained = train(network(str(weights), 1), [pool], course, tmp_path / "c.pt", lambda _: None, CPU)
    state = torch.load(tmp_path / "c.pt", weights_only=True)
    assert set(state["weights"]) == set(trained_weights(trained)) and "optimizer" not in state
    again = train(network(str(weights), 1), [pool], course, tmp_path / "c.pt", pytest.fail, CPU)
    assert np.array_equal(predicted(again, pool.color, CPU), predicted(trained, pool.color, CPU))


def test_relative_weights_without_training_give_the_inverse_of_disparity(weights, pool):
    plain = network(str(weights), 0, adapted=False).eval()
    assert plain.relative
    photos = torch.from_numpy(pool.color[:1].transpose(0, 3, 1, 2)).float() / 255
    with torch.inference_mode():
        disparity = plain.model(pixel_values=(photos - plain.mean) / plain.deviation).predicted_depth
        assert torch.allclose(plain(photos), 1 / disparity.clamp(min=1e-3), rtol=1e-4)


def test_a_study_with_weights_has_a_row_for_the_network_as_published(weights, made, tmp_path):
    test = tube_sequence.write(tmp_path / "test", 2, 40, 30)
    plan = Plan(network=str(weights), frames=2, steps=1, seeds=1)
    findings = study_depth([made / "tube"], [made / "twin"], [test], tmp_path / "s", plan)
    assert [arm.name for arm in findings.arms] == ["zero-shot", "real", "rendered", "both"]
    rows = (tmp_path / "s" / "depth.csv").read_text(encoding="utf-8").splitlines()
    assert sum(",zero-shot," in row for row in rows) == 2 and len(rows) == 9
    assert "as they are" in (tmp_path / "s" / "depth.html").read_text(encoding="utf-8")

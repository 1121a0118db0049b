"""Training: the same steps for every arm; a run that stops goes on where it was."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from torch import nn
from torch.nn import functional
from torch.utils.data import ConcatDataset

from endotwin.run.output import whole_file
from endotwin.study.accuracy import FARTHEST_MM
from endotwin.study.frames import Frames

HUBER_MM = 5.0
SILOG_WEIGHT = 0.5
CHECKPOINT_STEPS = 100


def huber(predicted_mm: torch.Tensor, depth_mm: torch.Tensor, has: torch.Tensor) -> torch.Tensor:
    """Mean Huber loss of the pixels that have depth: quadratic below 5 mm."""
    known_mm = torch.where(has, depth_mm, predicted_mm.detach())  # summing all is faster than picking
    return functional.huber_loss(predicted_mm, known_mm, reduction="sum", delta=HUBER_MM) / has.sum()


def silog(predicted_mm: torch.Tensor, depth_mm: torch.Tensor, has: torch.Tensor) -> torch.Tensor:
    """√(mean g² − ½·(mean g)²), g = ln d − ln p, of the pixels that have depth (Eigen et al. 2014; Depth
    Anything V2's metric recipe)."""
    g = depth_mm[has].log() - predicted_mm[has].clamp(min=1e-3).log()
    return (g.square().mean() - SILOG_WEIGHT * g.mean().square() + 1e-12).sqrt()


LOSSES = {"huber": huber, "silog": silog}


@dataclass(frozen=True)
class Course:
    """How a network is trained.

    Attributes:
        steps, batch: as many photos of each are seen. rate: of Adam, at first; it falls as a cosine to 0.
        loss: a name among LOSSES. seed: of first weights, batches and flips.
    """

    steps: int
    batch: int
    rate: float
    loss: str
    seed: int


def train(
    network: nn.Module,
    pools: list[Frames],
    course: Course,
    checkpoint: Path,
    progress: Callable[[int], None],
    device: torch.device,
) -> nn.Module:
    """Train ``network`` on the frames of all ``pools`` as one set, flipped at random.

    Batches depend on seed and step alone, so that a run that goes on from ``checkpoint`` ends with the same
    weights.

    Args:
        checkpoint: file of weights and optimiser, at the end of the weights alone.
        progress: called with the number of steps that are done.
    """
    network.to(device).train()
    weights = [each for each in network.parameters() if each.requires_grad]
    optimizer = torch.optim.Adam(weights, lr=course.rate, fused=True)
    first = _resumed(network, optimizer, checkpoint, course)
    for step in range(first, course.steps):
        for group in optimizer.param_groups:
            group["lr"] = course.rate * 0.5 * (1 + math.cos(math.pi * step / course.steps))
        color, depth_mm = (each.to(device) for each in batch(pools, course, step))
        has = (depth_mm > 0) & (depth_mm <= FARTHEST_MM)
        if has.any():
            optimizer.zero_grad()
            LOSSES[course.loss](network(color), depth_mm, has).backward()
            nn.utils.clip_grad_norm_(weights, 1.0)
            optimizer.step()
        done = step + 1
        progress(done)
        if done % CHECKPOINT_STEPS == 0 or done == course.steps:
            state = {"course": asdict(course), "step": done, "weights": trained_weights(network)}
            if done < course.steps:
                state["optimizer"] = optimizer.state_dict()
            with whole_file(checkpoint, overwrite=True) as file:
                torch.save(state, file)
    return network.eval()


def trained_weights(network: nn.Module) -> dict[str, torch.Tensor]:
    """Those that training changes, by name."""
    return {name: each.detach() for name, each in network.named_parameters() if each.requires_grad}


def finished(checkpoint: Path, course: Course) -> bool:
    """Whether a training has come to its end, and needs no frames."""
    state = _saved(checkpoint, course)
    return state is not None and state["step"] == course.steps


def _saved(checkpoint: Path, course: Course) -> dict | None:
    """What is kept of a training of the same course."""
    if not checkpoint.exists():
        return None
    state = torch.load(checkpoint, map_location="cpu", weights_only=True)
    return state if state["course"] == asdict(course) else None


def _resumed(network: nn.Module, optimizer: torch.optim.Optimizer, checkpoint: Path, course: Course) -> int:
    """The step to go on from."""
    state = _saved(checkpoint, course)
    if state is None:
        return 0
    network.load_state_dict(state["weights"], strict=False)
    if "optimizer" in state:
        optimizer.load_state_dict(state["optimizer"])
    return state["step"]


def batch(pools: list[Frames], course: Course, step: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Photos [B, 3, H, W] in [0, 1] and depth [B, H, W] in mm of one step."""
    generator = np.random.default_rng([course.seed, step])
    frames = ConcatDataset(pools)
    colors, depths = [], []
    for _ in range(course.batch):
        index = int(generator.integers(len(frames)))
        across, down = (slice(None, None, -1 if flip else 1) for flip in generator.random(2) < 0.5)
        color, depth_mm = frames[index]
        colors.append(color[down, across])
        depths.append(depth_mm[down, across])
    return as_tensor(np.stack(colors)), torch.from_numpy(np.stack(depths))


def as_tensor(color: np.ndarray) -> torch.Tensor:
    """Photos uint8 [B, H, W, 3] as float32 [B, 3, H, W] in [0, 1]."""
    return torch.from_numpy(color).permute(0, 3, 1, 2).float() / 255


def predicted(network: nn.Module, color: np.ndarray, device: torch.device) -> np.ndarray:
    """Depth in mm, float32 [B, H, W], of photos uint8 [B, H, W, 3]."""
    with torch.inference_mode():
        return network(as_tensor(color).to(device)).cpu().numpy()

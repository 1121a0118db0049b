"""Depth networks: modules that take photos [B, 3, H, W] in [0, 1] to depth in mm [B, H, W].

Each has a ``name``, the ``size`` (width, height) of its images, the ``batch`` and the ``rate`` that it is
trained with, and ``steps``, or ``epochs`` of the rendered frames.
"""

from __future__ import annotations

import logging
from pathlib import Path
from threading import Lock

import torch
from torch import nn

from endotwin.errors import OptionError
from endotwin.study.depth_anything import WEIGHTS, DepthAnything
from endotwin.study.small import Small

logger = logging.getLogger("endotwin")

_drawing = Lock()
"""Held while first weights are drawn: all threads draw from one generator."""


def found(asked: str) -> str:
    """The network that ``asked`` names: ``small``, or the place of Depth Anything's weights.

    ``auto`` is Depth Anything where the cache of Hugging Face holds it, else the small network, with a word.
    """
    if asked != "auto":
        return asked
    try:
        DepthAnything(WEIGHTS, adapted=False)
    except OptionError:
        logger.warning("no weights of %s are on this machine: the small network runs", WEIGHTS)
        return "small"
    return WEIGHTS


def network(name: str, seed: int, adapted: bool = True) -> nn.Module:
    """The network ``name``, as ``found`` gives it, with first weights of ``seed``; raises OptionError.

    Args:
        adapted: whether it will be trained.
    """
    if name != "small" and Path(name).exists() and not (Path(name) / "config.json").is_file():
        raise OptionError(
            f"{name} has no config.json; give a folder with weights of Depth Anything, or small"
        )
    with _drawing:
        torch.manual_seed(seed)
        return Small() if name == "small" else DepthAnything(name, adapted)

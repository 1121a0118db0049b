"""Depth Anything V2 (Yang et al. 2024) from weights on this machine, adapted with LoRA (Hu et al. 2022).

As Han & Wu fine-tune it: rank 8 on queries, keys, values, the layers after them, and both layers of each
MLP; the head is trained whole; metric depth up to 100 mm.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import torch
from torch import nn
from torch.nn import functional

from endotwin.errors import OptionError
from endotwin.study.accuracy import FARTHEST_MM

WEIGHTS = "depth-anything/Depth-Anything-V2-Small-hf"
"""Those that are looked for in the cache of Hugging Face."""

RANK = 8
ADAPTED = ("query", "key", "value", "dense", "q_proj", "k_proj", "v_proj", "o_proj", "fc1", "fc2")
"""Layers with LoRA, as older and newer versions of transformers call them."""

MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
PATCHES = (18, 14)
LEAST_DISPARITY = 1e-3


class DepthAnything(nn.Module):
    """The network for metric depth in mm; without LoRA it is as its authors published it.

    Args:
        place: a folder with ``config.json`` and weights, or a name in the cache of Hugging Face.
        adapted: whether it is to be trained.

    Raises:
        OptionError: transformers or peft is missing, or no weights are there.
    """

    name = "Depth Anything V2"
    batch = 4
    rate = 1e-4
    epochs = 10

    def __init__(self, place: Path | str, adapted: bool) -> None:
        super().__init__()
        try:
            from peft import LoraConfig, get_peft_model
            from transformers import AutoConfig, DepthAnythingForDepthEstimation
        except ImportError as error:
            raise OptionError(
                "Depth Anything needs transformers and peft; install them with pip install 'endotwin[depth]'"
            ) from error
        try:
            config = AutoConfig.from_pretrained(place, local_files_only=True)
            self.relative = getattr(config, "depth_estimation_type", None) != "metric" and not adapted
            if not self.relative:
                config.depth_estimation_type, config.max_depth = "metric", int(FARTHEST_MM)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                model = DepthAnythingForDepthEstimation.from_pretrained(
                    place, config=config, local_files_only=True
                )
        except (OSError, ValueError, AttributeError, RuntimeError) as error:
            raise OptionError(
                f"{place} holds no weights of Depth Anything that transformers can read from this machine; "
                "give the folder with its config.json and model.safetensors"
            ) from error
        self.size = tuple(count * config.patch_size for count in PATCHES)
        if adapted:
            names = {name.rpartition(".")[2] for name, _ in model.backbone.named_modules()}
            lora = LoraConfig(
                r=RANK, lora_alpha=RANK, target_modules=sorted(names & set(ADAPTED)), modules_to_save=["head"]
            )
            model = get_peft_model(model, lora)
        self.model = model
        self.register_buffer("mean", torch.tensor(MEAN)[:, None, None])
        self.register_buffer("deviation", torch.tensor(DEVIATION)[:, None, None])

    def forward(self, color: torch.Tensor) -> torch.Tensor:
        """Depth in mm [B, H, W] of photos [B, 3, H, W] in [0, 1].

        The farthest depth of metric weights counts as 100 mm. Relative weights give 1/disparity, of any
        scale.
        """
        found = self.model(pixel_values=(color - self.mean) / self.deviation).predicted_depth[:, None]
        found = functional.interpolate(found, color.shape[2:], mode="bilinear", align_corners=False)[:, 0]
        return 1 / found.clamp(min=LEAST_DISPARITY) if self.relative else found

"""What is fitted: materials as hash features over a mean, and what all pixels share; and how both move where
light bounces, which tells how bright the tissue is."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from endotwin.fit.hashgrid import HashOperator
from endotwin.fit.model import Globals
from endotwin.light.radiosity import ALBEDO_MAX

ROUGHNESS_RANGE = (0.08, 1.0)

COLOR_RANGE = (1e-3, 100.0)
"""Of base colour before light and albedo share their scale: so far from where a fit may go that nothing stops
at the clamp, beyond which no step finds a lower cost."""

GLOBAL_RANGE = (
    *((-20.0, 20.0), (0.0, 10.0), (0.0, 4.0), (0.15, 1.5), (-6.0, -0.7)),
    *((-0.75, 0.0), (0.0, 0.9), (-4.0, 4.0)),
)
"""Bounds of the shared parameters, in the order of EVERY_GLOBAL: no lens passes more light at its rim."""

DARKEST = 0.24
"""Share of the light that the brightest tissue (98th percentile) reflects at least. Less is asked for where
no light bounces, and more than ALBEDO_MAX where a mesh lacks what throws light on it."""


@dataclass(frozen=True)
class State:
    """What is fitted: table [R, 4] of one operator, its mean [4] or [V, 4], and the shared parameters.

    Without an operator the mean is all there is. ``told``: bool [V], vertices that photos tell of; None: all.
    """

    operator: HashOperator | None
    mean: Tensor
    table: Tensor | None
    shared: Globals
    told: Tensor | None = None

    @cached_property
    def raw(self) -> Tensor:
        """θ = θ̄ + A·table, [V, 4]."""
        return self.mean if self.operator is None else self.mean + self.operator(self.table)

    @property
    def textured(self) -> bool:
        """Whether places may differ in their materials: before the first step they do not."""
        return self.mean.dim() == 2 or bool(self.table.any())

    @cached_property
    def materials(self) -> Tensor:
        """Base colour and roughness of every vertex, [V, 4]."""
        raw = self.raw
        low, high = ROUGHNESS_RANGE
        return torch.cat(
            [self._shown(raw) ** (1 / self.shared.gamma), low + (high - low) * torch.sigmoid(raw[:, 3:])],
            dim=1,
        )

    @property
    def told_color(self) -> Tensor:
        """Base colour of the vertices that photos tell of, [N, 3]: what others hold is no tissue's."""
        color = self.materials[:, :3]
        return color if self.told is None else color[self.told]

    @cached_property
    def mean_log_color(self) -> Tensor:
        """Mean of ln of the base colours that photos tell of, [3]."""
        return self.told_color.log().mean(dim=0)

    @property
    def glossy_albedo(self) -> float:
        """Mean share of light from all around that white lobes send back, unscaled as base colours are."""
        return float(self.shared.lobes.glossy_albedo(self.materials[:, 3]).mean())

    @property
    def lighting(self) -> Globals:
        """The shared parameters, with how bright the tissue is that light bounces off."""
        return replace(self.shared, tissue=self.mean_log_color) if self.shared.bounces else self.shared

    @cached_property
    def link_slope(self) -> Tensor:
        """d materials / dθ, [V, 4]. Base colour keeps its slope at the clamp, so that it can come back."""
        raw, gamma = self.raw, self.shared.gamma
        low, high = ROUGHNESS_RANGE
        s = torch.sigmoid(raw[:, 3:])
        return torch.cat([self._shown(raw) ** (1 / gamma - 1) / gamma, (high - low) * s * (1 - s)], dim=1)

    def _shown(self, raw: Tensor) -> Tensor:
        """Base colour as displayed, b^γ [V, 3]: the form in which it is fitted, since there the photo is
        linear in it.
        """
        low, high = (bound**self.shared.gamma for bound in COLOR_RANGE)
        return raw[:, :3].clamp(low, high)


def roughness_to_raw(roughness: float) -> float:
    low, high = ROUGHNESS_RANGE
    share = (roughness - low) / (high - low)
    return float(np.log(share / (1 - share)))


def roughness_slope(roughness: Tensor) -> Tensor:
    """d roughness / d logit."""
    low, high = ROUGHNESS_RANGE
    return (roughness - low) * (high - roughness) / (high - low)


def too_dark(state: State) -> bool:
    """Whether light between tissue asks for darker tissue than there is."""
    return brightest(state) * math.exp(state.shared.log_scale) < DARKEST


def without_furnace(state: State) -> State:
    """``state`` with the albedo's scale such that the brightest tissue reflects at most ALBEDO_MAX."""
    limit = math.log(ALBEDO_MAX / brightest(state))
    return state if state.shared.log_scale <= limit else rescaled(state, limit)


def at_furnace(state: State, rise: np.ndarray) -> int | None:
    """The channel, if any, whose brightest tissue would be a furnace after half of a step by which ln of each
    channel's albedo ``rise``s, [3]."""
    if not len(rise):
        return None
    color = np.percentile(state.told_color.cpu().numpy(), 98, axis=0)
    beyond = np.log(color / ALBEDO_MAX) + state.shared.log_scale + rise / 2
    return int(beyond.argmax()) if beyond.max() > 0 and rise[beyond.argmax()] > 0 else None


def brightest(state: State) -> float:
    """98th percentile of the brightest albedo channel, unscaled."""
    return float(np.percentile(state.told_color.amax(dim=1).cpu().numpy(), 98))


def as_bright(state: State, other: State) -> State:
    """``state``, whose white lobes are others than those of the ``other``, with the albedo's scale by which
    all its lobes send back as much light of the brightest channel: that the bounce has told."""
    was, now = (float(each.mean_log_color.exp().max()) + each.glossy_albedo for each in (other, state))
    return rescaled(state, state.shared.log_scale + math.log(was / now))


def halfway(state: State, other: State) -> State:
    """The state between two of one operator and mean."""
    vector = (state.shared.vector + other.shared.vector) / 2
    shared = replace(other.shared, vector=vector)
    return replace(other, table=(state.table + other.table) / 2, shared=shared)


def rescaled(state: State, log_scale: float) -> State:
    """``state`` with another scale of the albedo."""
    vector = state.shared.vector.clone()
    vector[-1] = log_scale
    return replace(state, shared=bounded(state.shared, vector))


def bounded(shared: Globals, vector: Tensor) -> Globals:
    limits = torch.tensor(GLOBAL_RANGE, dtype=torch.float64)[shared.places]
    return replace(shared, vector=torch.clamp(vector, limits[:, 0], limits[:, 1]))

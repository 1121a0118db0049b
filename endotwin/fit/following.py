"""Bounced light follows the colours of all tissue: what that adds to the normal equations of a step.

How bright tissue is on the whole depends on every entry of the table, and lights every pixel. As a matrix
that is full, but of rank 3: with g the slopes by ln of the light's scale in each channel, and u(step) what is
added to that, slopes by the table are J + g·uᵀ, and JᵀWJ becomes (J + g·uᵀ)ᵀ·W·(J + g·uᵀ).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from endotwin.light.bounced import WITH_ALL


@dataclass(frozen=True)
class Following:
    """Of a table of R entries.

    Attributes:
        along: [R, 3], change of ln of each channel's mean colour by its entries. turn: [3, 3], u by these
            changes. border: [R, 4, 3], JᵀWg. inner: [3, 3], gᵀWg.
    """

    along: Tensor
    turn: Tensor
    border: Tensor
    inner: Tensor

    @staticmethod
    def turning(kept: int | None) -> Tensor:
        """u by the changes of each channel's mean; where the albedo of the channel ``kept`` is to stay what
        it is, by a scale of all."""
        turn = WITH_ALL * torch.eye(3)
        if kept is not None:
            turn[:, kept] -= 1
        return turn

    def whiter(self, step: Tensor) -> Tensor:
        """Change of ln of each channel's mean colour by steps [R, 4, K], [3, K]."""
        return torch.einsum("rc,rck->ck", self.along, step[:, :3])

    def right(self, pulls: Tensor) -> Tensor:
        """What pulls [3, K] at the light's scales are at the table, [R, 4, K]."""
        return torch.nn.functional.pad(self.along[:, :, None] * (self.turn.T @ pulls), (0, 0, 0, 1))

    def product(self, step: Tensor) -> Tensor:
        """What is more of the normal matrix's product with steps [R, 4, K]."""
        turned = self.turn @ self.whiter(step)
        pulls = self.border.flatten(0, 1).T @ step.flatten(0, 1) + self.inner @ turned
        return self.border.flatten(0, 1).matmul(turned).reshape(step.shape) + self.right(pulls)

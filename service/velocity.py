"""u_phi: a value for every velocity level, given the chosen sensor's context and its distance."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from service.attention import WIDTH


class VelocityScorer(nn.Module):
    """``u = W_2 relu(W_1 [z_j, distance] + b_1) + b_2``, one value a velocity level."""

    def __init__(self, levels: int, width: int = WIDTH) -> None:
        super().__init__()
        self.hidden = nn.Linear(width + 1, width)
        self.out = nn.Linear(width, levels)

    def forward(self, z: Tensor, distance: Tensor) -> Tensor:
        """Values ``(levels,)`` from the context ``(d',)`` and the normalised distance, a scalar tensor."""
        u: Tensor = self.out(torch.relu(self.hidden(torch.cat([z, distance.reshape(1)]))))
        return u

"""Attn_theta: one-head attention over the sensors, a scalar score each, and the top k."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

WIDTH = 32


class Attention(nn.Module):
    """Scaled dot-product attention, one head of width d' = 32, and a linear score.

    ``Q, K, V = X W_q, X W_k, X W_v``; ``Z = softmax(Q K^T / sqrt(d')) V``; ``s = Z w + b``. Callers pass the
    admissible sensors only: a masked sensor never reaches the softmax. torch's fused kernel keeps no J x J tensor.
    """

    def __init__(self, features: int, width: int = WIDTH) -> None:
        super().__init__()
        self.query = nn.Linear(features, width, bias=False)
        self.key = nn.Linear(features, width, bias=False)
        self.value = nn.Linear(features, width, bias=False)
        self.score = nn.Linear(width, 1)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Scores ``(n,)`` and contexts ``(n, d')`` of n admissible sensors' features ``(n, d)``."""
        q, k, v = (project(x)[None, None] for project in (self.query, self.key, self.value))
        z = functional.scaled_dot_product_attention(q, k, v)[0, 0]
        return self.score(z)[:, 0], z


def top_k(scores: Tensor, k: int) -> list[int]:
    """Indices of the k best scores, best first; all of them where there are fewer than k."""
    return [int(i) for i in torch.topk(scores, min(k, len(scores))).indices]

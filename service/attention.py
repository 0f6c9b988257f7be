"""Attn_theta: one-head attention over the sensors, a scalar score each, and the top k."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

WIDTH = 32


class Attention(nn.Module):
    """Scaled dot-product attention, one head of width d' = 32, and a linear score.

    ``Q, K, V = X W_q, X W_k, X W_v``; ``Z = softmax(Q K^T / sqrt(d')) V``; ``s = Z w + b``. Callers pass the
    admissible sensors only, or say which they are: a masked sensor never reaches the softmax. torch's fused kernel
    keeps no J x J tensor.
    """

    def __init__(self, features: int, width: int = WIDTH) -> None:
        super().__init__()
        self.query = nn.Linear(features, width, bias=False)
        self.key = nn.Linear(features, width, bias=False)
        self.value = nn.Linear(features, width, bias=False)
        self.score = nn.Linear(width, 1)

    def forward(self, x: Tensor, admissible: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Scores ``(..., n)`` and contexts ``(..., n, d')`` of n sensors' features ``(..., n, d)``.

        Args:
            admissible: ``(..., n)`` booleans; what comes out for the others means nothing. Default: all are.
        """
        # Only with four axes (batch, head, n, d') does torch take the kernel that keeps no n x n tensor.
        n, d = x.shape[-2:]
        q, k, v = (project(x.reshape(-1, 1, n, d)) for project in (self.query, self.key, self.value))
        mask = None if admissible is None else admissible.reshape(-1, 1, 1, n)
        z = functional.scaled_dot_product_attention(q, k, v, attn_mask=mask).reshape(*x.shape[:-1], -1)
        return self.score(z)[..., 0], z


def top_k(scores: Tensor, k: int) -> list[int]:
    """Indices of the k best scores, best first; all of them where there are fewer than k."""
    best: list[int] = torch.topk(scores, min(k, len(scores))).indices.tolist()
    return best

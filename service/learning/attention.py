"""Attn_theta: one-head attention over the sensors, a scalar score each, and the top k."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from service.config.cores import usable_cores

WIDTH = 32
# Sensors from which on their queries are shared among cores. Of 768 queries and more torch's kernel takes 256 at a
# time: shares of whole blocks, at least four of them, give what all at once give, to the bit.
_MANY, _BLOCK, _LEAST_BLOCKS = 2048, 256, 4


class AttentionWeights(NamedTuple):
    """``W_q``, ``W_k``, ``W_v`` ``(d', d)``, and the score's ``w`` ``(1, d')`` and ``b`` ``(1,)``."""

    query: Tensor
    key: Tensor
    value: Tensor
    score: Tensor
    bias: Tensor


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
        """As :func:`attend`."""
        linear = self.query.weight, self.key.weight, self.value.weight
        return attend(AttentionWeights(*linear, self.score.weight, self.score.bias), x, admissible)


def attend(weights: AttentionWeights, x: Tensor, admissible: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Scores ``(..., n)`` and contexts ``(..., n, d')`` of n sensors' features ``(..., n, d)``.

    Args:
        admissible: ``(..., n)`` booleans; what comes out for the others means nothing. Default: all are.
    """
    # Only with four axes (batch, head, n, d') does torch take the kernel that keeps no n x n tensor.
    n, d = x.shape[-2:]
    wide = x.reshape(-1, 1, n, d)
    q, k, v = (functional.linear(wide, w) for w in (weights.query, weights.key, weights.value))
    if admissible is None and n >= _MANY and torch.is_inference_mode_enabled():
        z = _by_cores(q, k, v)
    else:
        mask = None if admissible is None else admissible.reshape(-1, 1, 1, n)
        z = functional.scaled_dot_product_attention(q, k, v, attn_mask=mask)
    z = z.reshape(*x.shape[:-1], -1)
    return functional.linear(z, weights.score, weights.bias)[..., 0], z


def _by_cores(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """All queries' contexts, each core's share of them beside the others'."""

    @torch.inference_mode()
    def share(queries: Tensor) -> Tensor:
        return functional.scaled_dot_product_attention(queries, k, v)

    blocks = -(-q.shape[2] // _BLOCK)
    cores = min(usable_cores(), blocks // _LEAST_BLOCKS)
    rows = [_BLOCK * (blocks // cores + (core < blocks % cores)) for core in range(cores)]
    rows[-1] -= _BLOCK * blocks - q.shape[2]
    return torch.cat([*_threads(cores).map(share, torch.split(q, rows, dim=2))], dim=2)


@cache
def _threads(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix="attention")


def top_k(scores: Tensor, k: int) -> list[int]:
    """Indices of the k best scores, best first; all of them where there are fewer than k."""
    best: list[int] = torch.topk(scores, min(k, len(scores))).indices.tolist()
    return best

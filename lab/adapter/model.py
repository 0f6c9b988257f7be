"""The embedded LLM in torch with a LoRA adapter, in llama.cpp's order of rows, cut to the tokens that prompts use.

It is for a machine that has torch and numpy alone. Its logits are those of :class:`lab.distilling.student.Student`
within 6e-6 in float32 (compared on two prompts with the adapter that ships).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

_LAYERS, _WIDTH, _HEADS, _KV_HEADS, _HEAD = 30, 576, 9, 3, 64
_EPSILON, _THETA = 1e-5, 1e5
_MATRICES = ("attn_q", "attn_k", "attn_v", "attn_output", "ffn_gate", "ffn_up", "ffn_down")
# The adapter adds alpha / r B A, with alpha = 2 r.
_SCALE = 2.0


def dequantised(data: np.ndarray, kind: str) -> np.ndarray:
    """The numbers of a GGUF tensor of type F32, Q8_0 or Q4_1, from its bytes ``(..., row bytes)``."""
    if kind == "F32":
        return data.astype(np.float32)
    size = {"Q8_0": 34, "Q4_1": 20}[kind]
    blocks = data.reshape(*data.shape[:-1], -1, size)
    step = blocks[..., :2].copy().view(np.float16).astype(np.float32)
    if kind == "Q8_0":
        values = step * blocks[..., 2:].copy().view(np.int8)
    else:
        least = blocks[..., 2:4].copy().view(np.float16).astype(np.float32)
        values = step * np.concatenate((blocks[..., 4:] & 15, blocks[..., 4:] >> 4), axis=-1) + least
    return np.asarray(values.reshape(*data.shape[:-1], -1), dtype=np.float32)


class Adapted(nn.Module):
    """A matrix ``(out, in)`` with an adapter of rank r."""

    def __init__(self, matrix: Tensor, rank: int) -> None:
        super().__init__()
        self.register_buffer("matrix", matrix)
        self.a = nn.Parameter(torch.randn(rank, matrix.shape[1]) / matrix.shape[1] ** 0.5)
        self.b = nn.Parameter(torch.zeros(matrix.shape[0], rank))

    def forward(self, x: Tensor) -> Tensor:
        """The adapted product."""
        added = functional.linear(functional.linear(x, self.a.to(x.dtype)), self.b.to(x.dtype))
        return functional.linear(x, self.matrix) + _SCALE * added


class Model(nn.Module):
    """The LLM.

    Args:
        tensors: by GGUF name, with the rows of ``token_embd.weight`` that are used alone.
        kinds: their GGUF types.
    """

    def __init__(
        self, tensors: Mapping[str, np.ndarray], kinds: Mapping[str, str], rank: int, dtype: torch.dtype
    ) -> None:
        super().__init__()
        raw = {name: torch.tensor(dequantised(values, kinds[name])) for name, values in tensors.items()}
        self.register_buffer("embeddings", raw["token_embd.weight"].to(dtype))
        self.register_buffer("last_norm", raw["output_norm.weight"])
        self.register_buffer("frequencies", _THETA ** (-torch.arange(0, _HEAD, 2).float() / _HEAD))
        for layer in range(_LAYERS):
            for norm in ("attn_norm", "ffn_norm"):
                self.register_buffer(f"{norm}_{layer}", raw[f"blk.{layer}.{norm}.weight"])
        self.adapted = nn.ModuleDict(
            {
                f"{layer}_{name}": Adapted(raw[f"blk.{layer}.{name}.weight"].to(dtype), rank)
                for layer in range(_LAYERS)
                for name in _MATRICES
            }
        )

    def forward(self, ids: Tensor) -> Tensor:
        """The last layer's states ``(B, T, width)`` of tokens ``(B, T)``."""
        x = self.embeddings[ids]
        angles = torch.arange(ids.shape[1], device=ids.device).float()[:, None] * self.frequencies
        turn = angles.cos().to(x.dtype), angles.sin().to(x.dtype)
        for layer in range(_LAYERS):
            x = x + self._attended(_normed(x, getattr(self, f"attn_norm_{layer}")), layer, turn)
            h = _normed(x, getattr(self, f"ffn_norm_{layer}"))
            gate, up, down = (self.adapted[f"{layer}_ffn_{name}"] for name in ("gate", "up", "down"))
            x = x + down(functional.silu(gate(h)) * up(h))
        return _normed(x, self.last_norm)

    def logits(self, states: Tensor, tokens: Tensor) -> Tensor:
        """The logits of these tokens after states."""
        return functional.linear(states, self.embeddings[tokens].to(states.dtype)).float()

    def _attended(self, h: Tensor, layer: int, turn: tuple[Tensor, Tensor]) -> Tensor:
        batch, length, _ = h.shape
        q, k, v = (
            self.adapted[f"{layer}_attn_{name}"](h).view(batch, length, heads, _HEAD).transpose(1, 2)
            for name, heads in (("q", _HEADS), ("k", _KV_HEADS), ("v", _KV_HEADS))
        )
        groups = _HEADS // _KV_HEADS
        q, k, v = _turned(q, turn), _turned(k, turn).repeat_interleave(groups, 1), v.repeat_interleave(groups, 1)
        mixed = functional.scaled_dot_product_attention(q, k, v, is_causal=True)
        result: Tensor = self.adapted[f"{layer}_attn_output"](mixed.transpose(1, 2).reshape(batch, length, _WIDTH))
        return result

    def load_adapter(self, tensors: Mapping[str, np.ndarray]) -> None:
        """Take an adapter's tensors, by GGUF name."""
        with torch.no_grad():
            for key, own in self.adapted.items():
                layer, _, name = key.partition("_")
                for half, values in (("a", own.a), ("b", own.b)):
                    values.copy_(torch.tensor(tensors[f"blk.{layer}.{name}.weight.lora_{half}"]).float())

    def adapter(self) -> dict[str, np.ndarray]:
        """The adapter's tensors, by GGUF name, in 16 bits."""
        found = {}
        for key, own in self.adapted.items():
            layer, _, name = key.partition("_")
            for half, values in (("a", own.a), ("b", own.b)):
                found[f"blk.{layer}.{name}.weight.lora_{half}"] = values.detach().cpu().numpy().astype(np.float16)
        return found


def _normed(x: Tensor, weight: Tensor) -> Tensor:
    return functional.rms_norm(x.float(), (x.shape[-1],), weight, _EPSILON).to(x.dtype)


def _turned(x: Tensor, turn: Sequence[Tensor]) -> Tensor:
    """The rotary embedding, whose pairs are neighbours in llama.cpp's order."""
    even, odd = x[..., 0::2], x[..., 1::2]
    cosine, sine = turn
    return torch.stack((even * cosine - odd * sine, even * sine + odd * cosine), dim=-1).flatten(-2)

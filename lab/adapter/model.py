"""The embedded LLM in torch with a LoRA adapter, in llama.cpp's order of rows, cut to the tokens that prompts use.

It is for a machine that has torch and numpy alone. Its logits are those of :class:`lab.distilling.student.Student`
within 6e-6 in float32 (compared on two prompts with the adapter that ships).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from lab.precision import half_precision

_LAYERS, _WIDTH, _HEADS, _KV_HEADS, _HEAD = 30, 576, 9, 3, 64
_RANK = 16
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


class _Product(torch.autograd.Function):
    """``x W^T`` for ``W`` with the adapter added to it, with gradients for ``x``, ``a`` and ``b``."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, whole: Tensor, a: Tensor, b: Tensor) -> Tensor:
        ctx.save_for_backward(x, whole, a, b)
        return functional.linear(x, whole)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        x, whole, a, b = ctx.saved_tensors
        into, out = x.flatten(0, 1), gradient.flatten(0, 1)
        # `_SCALE` as a literal: torch 2.13 cannot compile a backward pass that reads a module's float.
        of_a = 2.0 * ((out @ b.to(x.dtype)).T @ into).to(a.dtype)
        of_b = 2.0 * (out.T @ (into @ a.to(x.dtype).T)).to(b.dtype)
        return gradient @ whole, None, of_a, of_b


class Adapted(nn.Module):
    """A matrix ``(out, in)`` with an adapter of rank r."""

    def __init__(self, matrix: Tensor, rank: int) -> None:
        super().__init__()
        self.register_buffer("matrix", matrix)
        self.a = nn.Parameter(torch.randn(rank, matrix.shape[1]) / matrix.shape[1] ** 0.5)
        self.b = nn.Parameter(torch.zeros(matrix.shape[0], rank))

    @torch.no_grad()
    def whole(self) -> Tensor:
        """The matrix with the adapter added to it."""
        added = torch.addmm(self.matrix.float(), self.b, self.a, alpha=_SCALE)
        return added.to(self.matrix.dtype)


# A layer's norms, and its matrices as in `_MATRICES`: each with the adapter added, and the adapter's two.
Layer = tuple[Tensor, Tensor, list[tuple[Tensor, Tensor, Tensor]]]


class Model(nn.Module):
    """The LLM.

    Args:
        tensors: by GGUF name, with the rows of ``token_embd.weight`` that are used alone.
        kinds: their GGUF types.
        vocabulary: the embeddings of all tokens.
    """

    def __init__(
        self,
        tensors: Mapping[str, np.ndarray],
        kinds: Mapping[str, str],
        vocabulary: np.ndarray,
        rank: int,
        dtype: torch.dtype,
    ) -> None:
        super().__init__()
        raw = {name: torch.tensor(dequantised(values, kinds[name])) for name, values in tensors.items()}
        self.register_buffer("embeddings", raw["token_embd.weight"].to(dtype))
        all_tokens = torch.tensor(dequantised(vocabulary, kinds["token_embd.weight"]))
        self.register_buffer("vocabulary", all_tokens.to(dtype))
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
        # One compilation for prompts of any number and length; with it a step on one core takes two thirds of its time.
        self._layer = torch.compile(_after_layer, dynamic=True)

    @classmethod
    def of(cls, base: Path, device: str) -> Self:
        """The LLM of :mod:`lab.adapter.base`, with an adapter that adds nothing yet."""
        tensors = {
            name: values for part in ("base0", "base1") for name, values in np.load(base / f"{part}.npz").items()
        }
        kinds = json.loads((base / "tokens.json").read_text())["kinds"]
        vocabulary = np.load(base / "vocabulary.npz")["all"]
        return cls(tensors, kinds, vocabulary, _RANK, half_precision(device)).to(device)

    def layers(self) -> list[Layer]:
        """The layers as :meth:`forward` takes them, of the adapter as it is now."""
        return [
            (getattr(self, f"attn_norm_{layer}"), getattr(self, f"ffn_norm_{layer}"), self._matrices(layer))
            for layer in range(_LAYERS)
        ]

    def _matrices(self, layer: int) -> list[tuple[Tensor, Tensor, Tensor]]:
        own: list[Adapted] = [self.adapted[f"{layer}_{name}"] for name in _MATRICES]  # type: ignore[misc]
        return [(one.whole(), one.a, one.b) for one in own]

    def forward(self, ids: Tensor, layers: Sequence[Layer]) -> Tensor:
        """The last layer's states ``(B, T, width)`` of tokens ``(B, T)``."""
        x, length = self.embeddings[ids], ids.shape[1]
        angles = torch.arange(length, device=ids.device).float()[:, None] * self.frequencies
        rotation = angles.cos().to(x.dtype), angles.sin().to(x.dtype)
        ahead = torch.full((length, length), -torch.inf, device=ids.device).triu(1).repeat(_HEADS // _KV_HEADS, 1)
        for own in layers:
            x = self._layer(x, own, rotation, ahead)
        return _normed(x, self.last_norm)

    def logits(self, states: Tensor, tokens: Tensor) -> Tensor:
        """The logits of these tokens after states."""
        return functional.linear(states, self.embeddings[tokens].to(states.dtype)).float()

    def all_logits(self, states: Tensor) -> Tensor:
        """The logits of all tokens of the vocabulary after states."""
        return functional.linear(states, self.vocabulary.to(states.dtype)).float()

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


def _after_layer(x: Tensor, layer: Layer, rotation: tuple[Tensor, Tensor], ahead: Tensor) -> Tensor:
    """The states ``(B, T, width)`` after a layer; ``ahead`` ``(T x group, T)`` is minus infinity for later tokens."""
    attention_norm, feed_norm, (query, key, value, output, gate, up, down) = layer
    batch, length, _ = x.shape
    h = _normed(x, attention_norm)
    q = _Product.apply(h, *query).view(batch, length, _HEADS, _HEAD).transpose(1, 2)
    k = _Product.apply(h, *key).view(batch, length, _KV_HEADS, _HEAD).transpose(1, 2)
    v = _Product.apply(h, *value).view(batch, length, _KV_HEADS, _HEAD).transpose(1, 2)
    # The heads of a group are neighbours, and share a key.
    q = _rotated(q, rotation).reshape(batch, _KV_HEADS, -1, _HEAD)
    scores = (q @ _rotated(k, rotation).transpose(2, 3)).float() * _HEAD**-0.5 + ahead
    mixed = (scores.softmax(-1).to(x.dtype) @ v).view(batch, _HEADS, length, _HEAD)
    x = x + _Product.apply(mixed.transpose(1, 2).reshape(batch, length, _WIDTH), *output)
    h = _normed(x, feed_norm)
    fed: Tensor = _Product.apply(functional.silu(_Product.apply(h, *gate)) * _Product.apply(h, *up), *down)
    return x + fed


def _normed(x: Tensor, weight: Tensor) -> Tensor:
    return functional.rms_norm(x.float(), (x.shape[-1],), weight, _EPSILON).to(x.dtype)


def _rotated(x: Tensor, rotation: Sequence[Tensor]) -> Tensor:
    """The rotary embedding, whose pairs are neighbours in llama.cpp's order."""
    even, odd = x[..., 0::2], x[..., 1::2]
    cosine, sine = rotation
    return torch.stack((even * cosine - odd * sine, even * sine + odd * cosine), dim=-1).flatten(-2)

"""The attention and velocity modules, which score a mission's sensors and the velocities for each of them.

Decisions use :class:`Weights`, a frozen copy of the parameters, with the functions :func:`attend`, :func:`by_distance`
and :func:`by_reach`. :class:`Modules` are the same computations as torch modules, for training offline.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from service.config.cores import usable_cores
from shared.features import FEATURES, LEVEL_FEATURES
from shared.wire import Features

Array = NDArray[np.float32]

WIDTH = 32
# From so many sensors on, the cores share the queries. From 768 queries on, torch's kernel takes 256 at a time: shares
# of at least four whole blocks give the same result to the bit as one call for all queries.
_MANY, _BLOCK, _LEAST_BLOCKS = 2048, 256, 4
# Numbers that torch computes at once: a parameter of a multiple of so many gives the same result wherever it lies.
_VECTOR = 32


class Sample(NamedTuple):
    """A training sample: one decision as the modules saw it.

    Attributes:
        features: of the admissible sensors, ``(n, d)``.
        chosen: row of the chosen sensor.
        approach: the velocity module's input for that sensor, see :meth:`State.approaches`.
        velocity: level that was flown.
    """

    features: Array
    chosen: int
    approach: Array
    velocity: int


class AttentionWeights(NamedTuple):
    """``W_q``, ``W_k``, ``W_v`` ``(d', d)``, and the score's ``w`` ``(1, d')`` and ``b`` ``(1,)``."""

    query: Tensor
    key: Tensor
    value: Tensor
    score: Tensor
    bias: Tensor


class VelocityWeights(NamedTuple):
    """``W_1``, ``b_1``, ``W_2``, ``b_2``."""

    hidden: Tensor
    hidden_bias: Tensor
    out: Tensor
    out_bias: Tensor


class Parameters(NamedTuple):
    """The parameters of both modules, or their gradients, as numpy arrays in the modules' order.

    ``W_q``, ``W_k``, ``W_v`` ``(d', d)``; the score's ``w`` ``(1, d')`` and ``b`` ``(1,)``; the velocity module's
    ``W_1`` ``(d', d' + a)``, ``b_1``, ``W_2`` ``(levels or 1, d')`` and ``b_2``.
    """

    query: Array
    key: Array
    value: Array
    score: Array
    bias: Array
    hidden: Array
    hidden_bias: Array
    out: Array
    out_bias: Array


def attend(weights: AttentionWeights, x: Tensor, admissible: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Scores ``(..., n)`` and contexts ``(..., n, d')`` of n sensors' features ``(..., n, d)``.

    Args:
        admissible: ``(..., n)`` booleans; the results of the other sensors mean nothing. Default: all are admissible.
    """
    # Only with four axes (batch, head, n, d') does torch take the kernel that makes no n x n tensor.
    n, d = x.shape[-2:]
    wide = x.reshape(-1, 1, n, d)
    q = functional.linear(wide, weights.query)
    k = functional.linear(wide, weights.key)
    v = functional.linear(wide, weights.value)
    if admissible is None and n >= _MANY and torch.is_inference_mode_enabled():
        z = _attend_on_cores(q, k, v)
    else:
        mask = None if admissible is None else admissible.reshape(-1, 1, 1, n)
        z = functional.scaled_dot_product_attention(q, k, v, attn_mask=mask)
    z = z.reshape(*x.shape[:-1], -1)
    return functional.linear(z, weights.score, weights.bias)[..., 0], z


def _attend_on_cores(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """The contexts of all queries; each core computes a share of them."""

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
    """Indices of the k best scores, best first; of all scores where there are fewer than k."""
    best: list[int] = torch.topk(scores, min(k, len(scores))).indices.tolist()
    return best


def by_distance(weights: VelocityWeights, z: Tensor, distance: Tensor) -> Tensor:
    """Values ``(..., levels)`` from the context ``(..., d')`` and the normalised distance ``(..., 1)``."""
    return _values(weights, torch.cat([z, distance], dim=-1))


def by_reach(weights: VelocityWeights, z: Tensor, levels: Tensor) -> Tensor:
    """Values ``(..., levels)`` from the context ``(..., d')`` and the levels' features ``(..., levels, 4)``."""
    context = z[..., None, :].expand(*levels.shape[:-1], z.shape[-1])
    return _values(weights, torch.cat([context, levels], dim=-1))[..., 0]


def _values(weights: VelocityWeights, x: Tensor) -> Tensor:
    hidden = torch.relu(functional.linear(x, weights.hidden, weights.hidden_bias))
    return functional.linear(hidden, weights.out, weights.out_bias)


class Weights:
    """The parameters that decisions compute with: a finished copy that nothing changes.

    Attributes:
        layout: positions of the parameters in ``flat``.
        flat: all parameters, ``(size,)``.
    """

    __slots__ = ("_attention", "_velocity", "flat", "layout")

    def __init__(self, layout: Layout, flat: Tensor) -> None:
        self.layout, self.flat = layout, flat
        # The views are made on first use: each training step makes new weights, and few decisions use them all.
        self._attention: AttentionWeights | None = None
        self._velocity: VelocityWeights | None = None

    @property
    def attention(self) -> AttentionWeights:
        """The attention module's parameters."""
        if self._attention is None:
            attention = slice(len(AttentionWeights._fields))
            self._attention = AttentionWeights(*self.layout.views(self.flat, attention))
        return self._attention

    @torch.inference_mode()
    def score(self, features: Array) -> tuple[Tensor, Tensor]:
        """Scores ``(n,)`` and contexts ``(n, d')`` of n sensors' features ``(n, d)``."""
        return attend(self.attention, torch.from_numpy(features))

    @torch.inference_mode()
    def velocities(self, contexts: Tensor, approaches: Array) -> list[Tensor]:
        """Values ``(levels,)`` of the velocities for each of n sensors, from their contexts ``(n, d')``."""
        if self._velocity is None:
            velocity = slice(len(AttentionWeights._fields), None)
            self._velocity = VelocityWeights(*self.layout.views(self.flat, velocity))
        values = by_distance if self.layout.preset == "paper" else by_reach
        # One after another: the last bits of a product depend on its size. No value may depend on the other sensors.
        return [values(self._velocity, *pair) for pair in zip(contexts, torch.from_numpy(approaches), strict=True)]


@dataclass(frozen=True, slots=True)
class Layout:
    """Positions of a preset's parameters in one flat array: first those of whole vectors of torch's.

    ``names``, ``shapes``, ``strides`` and ``starts`` are in the modules' order.
    """

    preset: Features
    names: tuple[str, ...]
    shapes: tuple[torch.Size, ...]
    strides: tuple[tuple[int, ...], ...]
    starts: tuple[int, ...]

    @classmethod
    def of(cls, preset: Features, named: Iterable[tuple[str, Tensor]]) -> Self:
        """The layout of a preset's modules, from their parameters by name."""
        names, parameters = zip(*named, strict=True)
        shapes = tuple(p.shape for p in parameters)
        starts, end = dict[int, int](), 0
        for index in sorted(range(len(shapes)), key=lambda index: shapes[index].numel() % _VECTOR != 0):
            starts[index], end = end, end + shapes[index].numel()
        strides = tuple(p.contiguous().stride() for p in parameters)
        return cls(preset, names, shapes, strides, tuple(starts[index] for index in range(len(shapes))))

    @property
    def size(self) -> int:
        """The number of all numbers."""
        return sum(shape.numel() for shape in self.shapes)

    def views(self, flat: Tensor, which: slice = slice(None)) -> list[Tensor]:
        """Views of the parameters in a flat array that begins its storage, in the modules' order."""
        positions = zip(self.shapes[which], self.strides[which], self.starts[which], strict=True)
        # A slice and a view of it take four times as long, and each training step makes new weights.
        return [flat.as_strided(*position) for position in positions]

    def arrays(self, flat: Tensor) -> Parameters:
        """The same views as numpy arrays."""
        numbers = flat.numpy()
        return Parameters(
            *(numbers[a : a + s.numel()].reshape(s) for a, s in zip(self.starts, self.shapes, strict=True))
        )

    def flat(self, parameters: Sequence[Tensor]) -> Tensor:
        """The flat array of parameters in the modules' order; raises ``RuntimeError`` where they have other shapes."""
        if [p.shape for p in parameters] != list(self.shapes):
            raise RuntimeError(
                f"the parameters do not have the shapes of preset {self.preset} at these velocity levels"
            )
        order = sorted(range(len(parameters)), key=self.starts.__getitem__)
        return torch.cat([parameters[index].reshape(-1) for index in order])


class Attention(nn.Module):
    """Scaled dot-product attention over the sensors, one head of width d' = 32, and a linear score.

    ``Q, K, V = X W_q, X W_k, X W_v``; ``Z = softmax(Q K^T / sqrt(d')) V``; ``s = Z w + b``. Callers pass the
    admissible sensors only, or a mask of them: a masked sensor never reaches the softmax. torch's fused kernel makes
    no J x J tensor.
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


class VelocityScorer(nn.Module):
    """``u = W_2 relu(W_1 [z_j, distance] + b_1) + b_2``, one value for each velocity level, as in the paper."""

    def __init__(self, levels: int, width: int = WIDTH) -> None:
        super().__init__()
        self.hidden = nn.Linear(width + 1, width)
        self.out = nn.Linear(width, levels)

    def forward(self, z: Tensor, distance: Tensor) -> Tensor:
        """As :func:`by_distance`."""
        return by_distance(_weights(self.hidden, self.out), z, distance)


class ReachVelocityScorer(nn.Module):
    """``u_v = w_2 relu(W_1 [z_j, a_v] + b_1) + b_2``, with the same weights for every velocity level v.

    ``a_v`` is a row of :meth:`State.approaches`, the effects of flying at v. So a scenario may have any number of
    levels.
    """

    def __init__(self, level_features: int, width: int = WIDTH) -> None:
        super().__init__()
        self.hidden = nn.Linear(width + level_features, width)
        self.out = nn.Linear(width, 1)

    def forward(self, z: Tensor, levels: Tensor) -> Tensor:
        """As :func:`by_reach`."""
        return by_reach(_weights(self.hidden, self.out), z, levels)


def _weights(hidden: nn.Linear, out: nn.Linear) -> VelocityWeights:
    return VelocityWeights(hidden.weight, hidden.bias, out.weight, out.bias)


class Modules(nn.Module):
    """The attention and velocity modules of one feature preset, which are trained jointly."""

    def __init__(self, preset: Features, levels: int, seed: int) -> None:
        super().__init__()
        self.preset: Features = preset
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.attention = Attention(FEATURES[preset])
            self.velocity = VelocityScorer(levels) if preset == "paper" else ReachVelocityScorer(LEVEL_FEATURES)

    def evaluate(self, sample: Sample) -> tuple[Tensor, Tensor]:
        """Scores ``(n,)`` of the sensors, and values ``(levels,)`` of the velocities for the chosen sensor."""
        scores, z = self.attention(torch.from_numpy(sample.features))
        return scores, self.velocity(z[sample.chosen], torch.from_numpy(sample.approach).to(z.dtype))

    def loss(self, sample: Sample, reward: float) -> Tensor:
        """``(s_j - r)^2 + (u_v - r)^2`` for the chosen sensor j and velocity v, r = -c."""
        scores, values = self.evaluate(sample)
        loss: Tensor = (scores[sample.chosen] - reward) ** 2 + (values[sample.velocity] - reward) ** 2
        return loss

    def weights(self) -> Weights:
        """A copy of the parameters for decisions."""
        layout = Layout.of(self.preset, self.named_parameters())
        return Weights(layout, layout.flat([p.detach() for p in self.parameters()]))

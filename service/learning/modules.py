"""The attention and velocity modules, which score a mission's sensors and the velocities for each of them.

Decisions use :class:`Weights`, a frozen copy of the parameters, with numpy or, for many sensors,
:mod:`service.learning.softmax_means`. :class:`Modules` are the same computations as torch modules, for training
offline.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from service.learning.softmax_means import Array, softmax, softmax_means
from shared.features.augmented_state import FEATURES, LEVEL_FEATURES
from shared.wire.schemas import Features

WIDTH = 32
# Fewer sensors are scored in numpy, with an n x n array.
_MANY = 64
# The attention module's fields of `Parameters`.
_ATTENTION = ("query", "key", "value", "score", "bias")


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


class Attended(NamedTuple):
    """The attention of n sensors: their scores ``(n,)``, and the contexts ``(m, d')`` of the sensors in some rows."""

    scores: Array
    contexts: Callable[[list[int]], Array]


def top_k(scores: Array, k: int) -> list[int]:
    """Indices of the k best scores, best first; of all where there are fewer. Of equals, the first."""
    losses = -scores
    if len(scores) <= max(_MANY, k):
        best: list[int] = losses.argsort(kind="stable")[:k].tolist()
        return best
    # Of many, only those not behind the k-th are sorted.
    ahead = np.flatnonzero(~(losses > np.partition(losses, k - 1)[k - 1]))
    best = ahead[losses[ahead].argsort(kind="stable")[:k]].tolist()
    return best


class Weights:
    """The parameters for decisions: an immutable copy.

    Attributes:
        layout: positions of the parameters in ``flat``.
        flat: all parameters, ``(size,)``.
        parameters: views of them.
    """

    __slots__ = ("flat", "layout", "parameters")

    def __init__(self, layout: Layout, flat: Array) -> None:
        self.layout, self.flat = layout, flat
        self.parameters = layout.arrays(flat)

    @property
    def attention(self) -> dict[str, Array]:
        """The attention module's parameters by name."""
        return {name: getattr(self.parameters, name) for name in _ATTENTION}

    def attend(self, features: Array) -> Attended:
        """Scores and contexts of n sensors' features ``(n, d)``, as :class:`Attention`."""
        return self._attend_few(features) if len(features) < _MANY else self._attend_many(features)

    def _attend_few(self, features: Array) -> Attended:
        own = self.parameters
        similar: Array = (features @ own.query.T) @ (features @ own.key.T).T
        similar *= np.float32(len(own.query) ** -0.5)
        z = softmax(similar) @ (features @ own.value.T)
        return Attended(z @ own.score[0] + own.bias[0], z.__getitem__)

    def _attend_many(self, features: Array) -> Attended:
        own = self.parameters
        # q_i k_j = x_i W_q^T W_k x_j, and what a score adds up is w W_v x_j: no head needs more than d dimensions.
        queries = features @ (own.query.T @ own.key) * np.float32(len(own.query) ** -0.5)
        values = features @ (own.score[0] @ own.value)
        scores = softmax_means(queries, features, values) + own.bias[0]
        return Attended(scores, partial(self._contexts, features, queries))

    def _contexts(self, features: Array, queries: Array, rows: list[int]) -> Array:
        """The contexts of some rows ``(m, d')``, from all features and queries ``(n, d)``."""
        contexts = np.empty((len(rows), len(self.parameters.value)), dtype=np.float32)
        # One at a time, as in `velocities`.
        for place, row in enumerate(rows):
            weights = softmax((features @ queries[row])[None])
            contexts[place] = self.parameters.value @ (weights @ features)[0]
        return contexts

    def velocities(self, contexts: Array, approaches: Array) -> list[Array]:
        """Values ``(levels,)`` of the velocities for each of n sensors, from their contexts ``(n, d')``."""
        own = self.parameters
        found = []
        # One at a time: the last bits of a product depend on its size, and no value may depend on the other sensors.
        for z, approach in zip(contexts, approaches, strict=True):
            if self.layout.preset == "paper":
                hidden = np.maximum(own.hidden @ np.concatenate((z, approach)) + own.hidden_bias, 0)
                found.append(own.out @ hidden + own.out_bias)
            else:
                levels = np.concatenate((np.broadcast_to(z, (len(approach), len(z))), approach), axis=1)
                hidden = np.maximum(levels @ own.hidden.T + own.hidden_bias, 0)
                found.append(hidden @ own.out[0] + own.out_bias[0])
        return found


class Layout:
    """Positions of a preset's parameters, in the modules' order, in one flat array.

    Attributes:
        names: of the parameters.
    """

    __slots__ = ("_shapes", "_starts", "names", "preset", "size")

    def __init__(self, preset: Features, named: Iterable[tuple[str, Tensor]]) -> None:
        self.preset = preset
        names, parameters = zip(*named, strict=True)
        self.names: tuple[str, ...] = names
        self._shapes = tuple(tuple(p.shape) for p in parameters)
        ends = np.cumsum([p.numel() for p in parameters]).tolist()
        self._starts = (0, *ends)
        self.size: int = ends[-1]

    def arrays(self, flat: Array) -> Parameters:
        """Views of the parameters in a flat array."""
        places = zip(self._starts, self._starts[1:], self._shapes, strict=False)
        return Parameters(*(flat[start:end].reshape(shape) for start, end, shape in places))

    def flat(self, parameters: Sequence[Array]) -> Array:
        """The flat array of parameters in the modules' order; raises ``ValueError`` if they have other shapes."""
        if [p.shape for p in parameters] != list(self._shapes):
            raise ValueError(f"the parameters do not have the shapes of preset {self.preset} at these velocity levels")
        return np.concatenate([np.ravel(p) for p in parameters])


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
        """Scores ``(..., n)`` and contexts ``(..., n, d')`` of n sensors' features ``(..., n, d)``.

        Args:
            admissible: ``(..., n)`` booleans; the results of the other sensors are meaningless. Default: all are true.
        """
        # Only for four axes (batch, head, n, d') torch selects the kernel without an n x n tensor.
        n, d = x.shape[-2:]
        wide = x.reshape(-1, 1, n, d)
        mask = None if admissible is None else admissible.reshape(-1, 1, 1, n)
        z = functional.scaled_dot_product_attention(self.query(wide), self.key(wide), self.value(wide), attn_mask=mask)
        z = z.reshape(*x.shape[:-1], -1)
        return self.score(z)[..., 0], z


class VelocityScorer(nn.Module):
    """``u = W_2 relu(W_1 [z_j, distance] + b_1) + b_2``, one value for each velocity level, as in the paper."""

    def __init__(self, levels: int, width: int = WIDTH) -> None:
        super().__init__()
        self.hidden = nn.Linear(width + 1, width)
        self.out = nn.Linear(width, levels)

    def forward(self, z: Tensor, distance: Tensor) -> Tensor:
        """Values ``(..., levels)`` from the context ``(..., d')`` and the normalised distance ``(..., 1)``."""
        values: Tensor = self.out(torch.relu(self.hidden(torch.cat([z, distance], dim=-1))))
        return values


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
        """Values ``(..., levels)`` from the context ``(..., d')`` and the levels' features ``(..., levels, 4)``."""
        context = z[..., None, :].expand(*levels.shape[:-1], z.shape[-1])
        values: Tensor = self.out(torch.relu(self.hidden(torch.cat([context, levels], dim=-1))))
        return values[..., 0]


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
        layout = Layout(self.preset, self.named_parameters())
        return Weights(layout, layout.flat([p.detach().numpy() for p in self.parameters()]))

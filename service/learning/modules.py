"""The attention and velocity modules, which score a mission's sensors and the velocities for each of them.

Decisions compute with numpy or, for many sensors, :mod:`service.learning.softmax_means`. The laboratory has the same
computations as torch modules, for training offline.

The attention has one head of width d' = 32: ``Q, K, V = X W_q, X W_k, X W_v``; ``Z = softmax(Q K^T / sqrt(d')) V``; a
sensor's score is ``s = w z + b``. The paper does not give its velocity module's architecture. Ours in
preset ``paper`` is ``u = W_2 relu(W_1 [z, distance] + b_1) + b_2``. In preset ``reach`` the value of the velocity level
v is ``u_v = w_2 relu(W_1 [z, a_v] + b_1) + b_2`` with the same weights for every level, where ``a_v`` is a row of
:meth:`State.approaches`: a scenario may have any number of levels.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple, Self

import numpy as np

from service.learning.softmax_means import Array, softmax, softmax_means
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
        return list(losses.argsort(kind="stable")[:k].tolist())
    # Of many, only those not behind the k-th are sorted.
    ahead = np.flatnonzero(~(losses > np.partition(losses, k - 1)[k - 1]))
    return list(ahead[losses[ahead].argsort(kind="stable")[:k]].tolist())


class Weights:
    """The parameters for decisions: an immutable copy.

    Attributes:
        layout: positions of the parameters in ``flat``.
        flat: all parameters, ``(size,)``.
        parameters: views of them.
    """

    __slots__ = ("flat", "layout", "parameters")

    def __init__(self, layout: "Layout", flat: Array) -> None:
        self.layout, self.flat = layout, flat
        self.parameters = layout.arrays(flat)

    @classmethod
    def of(cls, preset: Features, parameters: Mapping[str, Array]) -> Self:
        """A copy of the parameters by name, in the modules' order."""
        layout = Layout(preset, parameters)
        return cls(layout, layout.flat(list(parameters.values())))

    @property
    def attention(self) -> dict[str, Array]:
        """The attention module's parameters by name."""
        return {name: getattr(self.parameters, name) for name in _ATTENTION}

    def attend(self, features: Array) -> Attended:
        """Scores and contexts of n sensors' features ``(n, d)``."""
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
        scores = softmax_means(queries, features, features @ (own.score[0] @ own.value)) + own.bias[0]
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

    def __init__(self, preset: Features, parameters: Mapping[str, Array]) -> None:
        self.preset = preset
        self.names = tuple(parameters)
        self._shapes = tuple(p.shape for p in parameters.values())
        ends = np.cumsum([p.size for p in parameters.values()]).tolist()
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

"""Online value regression: both modules learn the realised cost of what was decided, one Adam step a feedback.

A mission keeps only numbers, its weights and Adam's moments: an edge flies thousands, and torch's modules take more
memory than what they compute with.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from service.adam import Moments, stepped
from service.attention import Attention, AttentionWeights, attend
from service.gradient import Parameters, Sample, descend
from service.velocity import ReachVelocityScorer, VelocityScorer, VelocityWeights, by_distance, by_reach
from shared.features import FEATURES
from shared.reach import LEVEL_FEATURES
from shared.wire import Features

# Numbers that torch computes at once: a parameter of so many, or a multiple, is computed the same wherever it lies.
_AT_ONCE = 32
# How many of the parameters are the attention module's: the first.
_ATTENTION = len(AttentionWeights._fields)


class Weights:
    """Modules as decisions use them: a finished copy that nothing changes.

    Attributes:
        layout: where in ``flat`` each parameter is.
        flat: all of them.
    """

    __slots__ = ("_attention", "_velocity", "flat", "layout")

    def __init__(self, layout: Layout, flat: Tensor) -> None:
        self.layout, self.flat = layout, flat
        # Made when they are asked for: each lesson makes other weights, and few decisions ask for all.
        self._attention: AttentionWeights | None = None
        self._velocity: VelocityWeights | None = None

    @property
    def attention(self) -> AttentionWeights:
        """Of the attention module."""
        if self._attention is None:
            self._attention = AttentionWeights(*self.layout.views(self.flat, slice(_ATTENTION)))
        return self._attention

    @property
    def velocity(self) -> VelocityWeights:
        """Of the velocity module."""
        if self._velocity is None:
            self._velocity = VelocityWeights(*self.layout.views(self.flat, slice(_ATTENTION, None)))
        return self._velocity

    @torch.inference_mode()
    def score(self, features: NDArray[np.float32]) -> tuple[Tensor, Tensor]:
        """Scores ``(n,)`` and contexts ``(n, d')`` of the sensors."""
        return attend(self.attention, torch.from_numpy(features))

    @torch.inference_mode()
    def velocities(self, z: Tensor, approach: NDArray[np.float32]) -> Tensor:
        """Values ``(levels,)`` of the velocities for one sensor."""
        values = by_distance if self.layout.preset == "paper" else by_reach
        return values(self.velocity, z, torch.from_numpy(approach))


class Modules(nn.Module):
    """The attention and velocity modules of one feature preset, which learn jointly."""

    def __init__(self, preset: Features, levels: int, seed: int) -> None:
        super().__init__()
        self.preset: Features = preset
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.attention = Attention(FEATURES[preset])
            self.velocity = VelocityScorer(levels) if preset == "paper" else ReachVelocityScorer(LEVEL_FEATURES)

    def evaluate(self, sample: Sample) -> tuple[Tensor, Tensor]:
        """Scores ``(n,)`` of the sensors, and values ``(levels,)`` of the velocities for the sensor decided."""
        scores, z = self.attention(torch.from_numpy(sample.features))
        return scores, self.velocity(z[sample.chosen], torch.from_numpy(sample.approach).to(z.dtype))

    def loss(self, sample: Sample, reward: float) -> Tensor:
        """``(s_j - r)^2 + (u_v - r)^2`` for the sensor j and velocity v decided, r = -c."""
        scores, values = self.evaluate(sample)
        loss: Tensor = (scores[sample.chosen] - reward) ** 2 + (values[sample.velocity] - reward) ** 2
        return loss

    def weights(self) -> Weights:
        """A copy to decide by."""
        layout = Layout.of(self)
        return Weights(layout, layout.flat([p.detach() for p in self.parameters()]))


@dataclass(frozen=True, slots=True)
class Layout:
    """Where each parameter of a preset's modules stands in one array of numbers: those that fill lines first.

    ``names``, ``shapes``, ``strides`` and ``starts`` are in the modules' own order.
    """

    preset: Features
    names: tuple[str, ...]
    shapes: tuple[torch.Size, ...]
    strides: tuple[tuple[int, ...], ...]
    starts: tuple[int, ...]

    @classmethod
    def of(cls, modules: Modules) -> Self:
        """The modules' own."""
        names, parameters = zip(*modules.named_parameters(), strict=True)
        shapes = tuple(p.shape for p in parameters)
        starts, end = dict[int, int](), 0
        for index in sorted(range(len(shapes)), key=lambda index: shapes[index].numel() % _AT_ONCE != 0):
            starts[index], end = end, end + shapes[index].numel()
        strides = tuple(p.contiguous().stride() for p in parameters)
        return cls(modules.preset, names, shapes, strides, tuple(starts[index] for index in range(len(shapes))))

    @property
    def size(self) -> int:
        """How many numbers there are."""
        return sum(shape.numel() for shape in self.shapes)

    def views(self, flat: Tensor, which: slice = slice(None)) -> list[Tensor]:
        """The parameters' places in the array, which begins its memory, in the modules' order, or of some of them."""
        places = zip(self.shapes[which], self.strides[which], self.starts[which], strict=True)
        # A slice and a view of it take four times as long, and every lesson makes other weights.
        return [flat.as_strided(*place) for place in places]

    def arrays(self, flat: Tensor) -> Parameters:
        """The same places as numpy has them."""
        numbers = flat.numpy()
        return Parameters(
            *(numbers[a : a + s.numel()].reshape(s) for a, s in zip(self.starts, self.shapes, strict=True))
        )

    def flat(self, parameters: Sequence[Tensor]) -> Tensor:
        """The array of parameters in the modules' order; raises ``RuntimeError`` where they have other shapes."""
        if [p.shape for p in parameters] != list(self.shapes):
            raise RuntimeError(f"of other modules than preset {self.preset}'s with these velocity levels")
        order = sorted(range(len(parameters)), key=self.starts.__getitem__)
        return torch.cat([parameters[index].reshape(-1) for index in order])


class _Places(threading.local):
    """Each thread's place for the gradient of a layout; made anew for each lesson, they would scatter the heap."""

    def __init__(self) -> None:
        self._made: dict[Layout, tuple[Tensor, Parameters]] = {}

    def of(self, layout: Layout) -> tuple[Tensor, Parameters]:
        """The gradient's array, and the places of the parameters in it."""
        if layout not in self._made:
            gradient = torch.zeros(layout.size)
            self._made[layout] = gradient, layout.arrays(gradient)
        return self._made[layout]


_places = _Places()


class Learner:
    """Adam over one mission's weights.

    ``update`` belongs to the event loop; ``score`` and ``velocities`` may be called from any thread: they compute with
    a finished copy, replaced whole after each update, so a decision never sees half a step. Until the first update the
    copy is every mission's that began with it.
    """

    def __init__(self, weights: Weights, *, learning_rate: float) -> None:
        self._layout = weights.layout
        self._learning_rate = learning_rate
        self._moments: Moments | None = None
        self._weights = weights
        self.updates = 0
        self.last_loss: float | None = None

    @property
    def attention(self) -> AttentionWeights:
        """The attention module's weights, as decisions use them now."""
        return self._weights.attention

    def score(self, features: NDArray[np.float32]) -> tuple[Tensor, Tensor]:
        """Scores ``(n,)`` and contexts ``(n, d')`` of n sensors' features ``(n, d)``."""
        return self._weights.score(features)

    def velocities(self, z: Tensor, approach: NDArray[np.float32]) -> Tensor:
        """Values ``(levels,)`` of the velocities for one sensor, from its context ``(d',)``."""
        return self._weights.velocities(z, approach)

    def update(self, sample: Sample, cost: float) -> float:
        """One step on one outcome; returns the loss before it.

        Raises:
            FloatingPointError: the gradient is not finite; nothing is learned, where weights would be lost for good.
        """
        before = self._weights.flat
        gradient, into = _places.of(self._layout)
        gradient.zero_()
        loss = descend(self._layout.arrays(before), sample, -cost, into=into)
        if not np.isfinite(gradient.numpy()).all():
            raise FloatingPointError("the gradient of a lesson is not finite")
        self._moments = self._moments or Moments.none(len(before))
        self._weights = Weights(self._layout, stepped(before, self._moments, gradient, self._learning_rate))
        # Who sees that it was learned sees the loss too.
        self.last_loss = loss
        self.updates += 1
        return loss

    def state_dict(self) -> dict[str, Any]:
        """Weights and Adam's moments as arrays."""
        views = self._layout.views
        adam: dict[int, dict[str, NDArray[np.float32]]] = {}
        if (kept := self._moments) is not None:
            for index, (mean, square) in enumerate(zip(views(kept.mean), views(kept.square), strict=True)):
                step = np.array(kept.steps, dtype=np.float32)
                adam[index] = {"step": step, "exp_avg": mean.numpy().copy(), "exp_avg_sq": square.numpy().copy()}
        weights = zip(self._layout.names, views(self._weights.flat), strict=True)
        return {
            "weights": {name: tensor.numpy().copy() for name, tensor in weights},
            "adam": adam,
            "updates": self.updates,
            "last_loss": self.last_loss,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """As it was when the state was taken; raises ``RuntimeError`` where that is of other modules."""

        def flat(arrays: Iterable[NDArray[np.float32]]) -> Tensor:
            return self._layout.flat([torch.from_numpy(array) for array in arrays])

        self._weights = Weights(self._layout, flat(state["weights"].values()))
        kept = [state["adam"][index] for index in sorted(state["adam"])]
        self._moments = None
        if kept:
            mean, square = flat(k["exp_avg"] for k in kept), flat(k["exp_avg_sq"] for k in kept)
            self._moments = Moments(mean, square, int(kept[0]["step"]))
        self.updates, self.last_loss = state["updates"], state["last_loss"]

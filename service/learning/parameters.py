"""The modules' parameters as one array of numbers, and the weights that decisions use."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from service.learning.attention import AttentionWeights, attend
from service.learning.backpropagation import Parameters
from service.learning.velocity import VelocityWeights, by_distance, by_reach
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
    def of(cls, preset: Features, named: Iterable[tuple[str, Tensor]]) -> Self:
        """Of a preset's modules, from their parameters by name."""
        names, parameters = zip(*named, strict=True)
        shapes = tuple(p.shape for p in parameters)
        starts, end = dict[int, int](), 0
        for index in sorted(range(len(shapes)), key=lambda index: shapes[index].numel() % _AT_ONCE != 0):
            starts[index], end = end, end + shapes[index].numel()
        strides = tuple(p.contiguous().stride() for p in parameters)
        return cls(preset, names, shapes, strides, tuple(starts[index] for index in range(len(shapes))))

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


class _GradientBuffers(threading.local):
    """Each thread's place for the gradient of a layout; made anew for each lesson, they would scatter the heap."""

    def __init__(self) -> None:
        self._made: dict[Layout, tuple[Tensor, Parameters]] = {}

    def of(self, layout: Layout) -> tuple[Tensor, Parameters]:
        """The gradient's array, and the places of the parameters in it."""
        if layout not in self._made:
            gradient = torch.zeros(layout.size)
            self._made[layout] = gradient, layout.arrays(gradient)
        return self._made[layout]


_buffers = _GradientBuffers()

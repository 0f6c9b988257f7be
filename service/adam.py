"""Adam over a few small parameters that lie side by side in one tensor.

Kingma and Ba 2015, the numbers of ``torch.optim.Adam`` to the bit. That class imports torch's compiler at its first
use, seconds in which nothing else of the process runs, and takes its steps a parameter at a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

_BETA1, _BETA2, _EPS = 0.9, 0.999, 1e-8
# Numbers that torch computes at once: a parameter of so many, or a multiple, is computed the same wherever it lies.
_AT_ONCE = 32


def lay_side_by_side(parameters: Sequence[nn.Parameter]) -> Tensor:
    """Move the parameters into one new tensor ``(n,)``, whose parts they then are; those that fill lines first."""
    order = _order(parameters)
    flat = torch.cat([parameters[index].detach().reshape(-1) for index in order])
    for index, part in zip(order, torch.split(flat, [parameters[index].numel() for index in order]), strict=True):
        parameters[index].data = part.view_as(parameters[index])
    return flat


class Adam:
    """One optimizer of one list of parameters, which it lays side by side.

    Attributes:
        weights: all parameters, ``(n,)``.
    """

    def __init__(self, parameters: Sequence[nn.Parameter], *, learning_rate: float) -> None:
        self._parameters = list(parameters)
        self._order = _order(self._parameters)
        self._sizes = [self._parameters[index].numel() for index in self._order]
        self._learning_rate = learning_rate
        self.weights = lay_side_by_side(self._parameters)
        self._steps = 0
        self._mean = torch.zeros_like(self.weights)
        self._square = torch.zeros_like(self.weights)

    @torch.no_grad()
    def step(self, gradients: Sequence[Tensor]) -> None:
        """One step down the gradients, one for each parameter, in the order of the parameters."""
        gradient = torch.cat([gradients[index].reshape(-1) for index in self._order])
        self._steps += 1
        self._mean.lerp_(gradient, 1 - _BETA1)
        self._square.mul_(_BETA2).addcmul_(gradient, gradient, value=1 - _BETA2)
        spread = (self._square.sqrt() / (1 - _BETA2**self._steps) ** 0.5).add_(_EPS)
        self.weights.addcdiv_(self._mean, spread, value=-self._learning_rate / (1 - _BETA1**self._steps))

    def state_dict(self) -> dict[int, dict[str, Any]]:
        """By parameter the arrays ``step``, ``exp_avg`` and ``exp_avg_sq``, as copies; empty before the first step."""
        if not self._steps:
            return {}
        parts = zip(torch.split(self._mean, self._sizes), torch.split(self._square, self._sizes), strict=True)
        found = {}
        for index, (mean, square) in zip(self._order, parts, strict=True):
            shape = self._parameters[index].shape
            found[index] = {
                "step": torch.tensor(float(self._steps)).numpy(),
                "exp_avg": mean.reshape(shape).numpy().copy(),
                "exp_avg_sq": square.reshape(shape).numpy().copy(),
            }
        return dict(sorted(found.items()))

    def load_state_dict(self, state: dict[int, dict[str, Any]]) -> None:
        """As it was when the state was taken; raises ``RuntimeError`` where that is of other parameters."""
        if not state:
            self._steps = 0
            self._mean.zero_()
            self._square.zero_()
            return
        if sorted(state) != sorted(self._order):
            raise RuntimeError(f"moments of {len(state)} parameters, where there are {len(self._order)}")
        self._steps = int(state[0]["step"])
        for name, kept in (("exp_avg", self._mean), ("exp_avg_sq", self._square)):
            kept.copy_(torch.cat([torch.as_tensor(state[index][name]).reshape(-1) for index in self._order]))


def _order(parameters: Sequence[nn.Parameter]) -> list[int]:
    return sorted(range(len(parameters)), key=lambda index: parameters[index].numel() % _AT_ONCE != 0)

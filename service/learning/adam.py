"""Adam over a few small parameters that lie side by side in one tensor.

Kingma and Ba 2015, the numbers of ``torch.optim.Adam`` to the bit. That class imports torch's compiler at its first
use, seconds in which nothing else of the process runs, and takes its steps a parameter at a time.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

_BETA1, _BETA2, _EPS = 0.9, 0.999, 1e-8


@dataclass(slots=True)
class Moments:
    """What Adam knows of one list of parameters after some steps: running means of the gradient and of its square."""

    mean: Tensor
    square: Tensor
    steps: int = 0

    @classmethod
    def none(cls, size: int) -> Moments:
        """Before the first step."""
        return cls(torch.zeros(size), torch.zeros(size))


@torch.no_grad()
def stepped(weights: Tensor, moments: Moments, gradient: Tensor, learning_rate: float) -> Tensor:
    """The weights ``(n,)`` after one more step down the gradient ``(n,)``.

    The moments are changed, and the gradient's place is used for something else.
    """
    moments.steps += 1
    mean, square = moments.mean, moments.square
    mean.lerp_(gradient, 1 - _BETA1)
    square.mul_(_BETA2).addcmul_(gradient, gradient, value=1 - _BETA2)
    spread = torch.sqrt(square, out=gradient).div_((1 - _BETA2**moments.steps) ** 0.5).add_(_EPS)
    return torch.addcdiv(weights, mean, spread, value=-learning_rate / (1 - _BETA1**moments.steps))

"""Where the modules start: the checkpoint that ships with the package, or random weights."""

from __future__ import annotations

from functools import cache
from importlib.resources import files

import torch
from torch import Tensor

from service.features import FEATURES
from service.learner import Modules
from shared.wire import Init

_LEVEL_TENSORS = ("velocity.out.weight", "velocity.out.bias")


def initial_modules(init: Init, levels: int, seed: int) -> Modules:
    """Modules for velocities 0..levels - 1, pretrained or random by seed.

    The checkpoint knows 0..14 m/s; a scenario with a lower limit takes the levels that it has.
    """
    modules = Modules(FEATURES, levels, seed)
    if init == "pretrained":
        weights = {k: v[:levels] if k in _LEVEL_TENSORS else v for k, v in _packaged().items()}
        modules.load_state_dict(weights)
    return modules


@cache
def _packaged() -> dict[str, Tensor]:
    with files("service").joinpath("checkpoints", "paper.pt").open("rb") as file:
        weights: dict[str, Tensor] = torch.load(file, weights_only=True)
    return weights

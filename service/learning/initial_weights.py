"""A mission's initial weights: those that ship with the package, or random ones."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from pathlib import Path

import torch
from torch import Tensor

from service.learning.modules import Modules, Weights
from shared.wire.schemas import Features, Init

# The weights of preset `paper` by velocity level; preset `reach` has none.
_LEVEL_TENSORS = ("velocity.out.weight", "velocity.out.bias")


def initial_modules(init: Init, preset: Features, levels: int, seed: int) -> Modules:
    """Modules of a feature preset for velocities 0..levels - 1, pretrained, or random by seed.

    The shipped weights have 0..14 m/s; a scenario with a lower limit uses the first levels.
    """
    modules = Modules(preset, levels, seed)
    if init == "pretrained":
        weights = _packaged(preset)
        if preset == "paper":
            weights = {k: v[:levels] if k in _LEVEL_TENSORS else v for k, v in weights.items()}
        modules.load_state_dict(weights)
    return modules


def initial_weights(init: Init, preset: Features, levels: int, seed: int) -> Weights:
    """The weights of :func:`initial_modules`; all missions share the pretrained ones."""
    return (
        _pretrained(preset, levels) if init == "pretrained" else initial_modules(init, preset, levels, seed).weights()
    )


@cache
def _pretrained(preset: Features, levels: int) -> Weights:
    return initial_modules("pretrained", preset, levels, seed=0).weights()


def save(modules: Modules, path: Path) -> None:
    """Write the modules' weights with the name of their feature preset."""
    torch.save({"features": modules.preset, "weights": modules.state_dict()}, path)


@cache
def _packaged(preset: Features) -> dict[str, Tensor]:
    with files("service").joinpath("checkpoints", f"{preset}.pt").open("rb") as file:
        checkpoint = torch.load(file, weights_only=True)
    if checkpoint["features"] != preset:
        raise ValueError(f"checkpoints/{preset}.pt has modules of the feature preset {checkpoint['features']}")
    weights: dict[str, Tensor] = checkpoint["weights"]
    return weights

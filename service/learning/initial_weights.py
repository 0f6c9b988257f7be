"""A mission's initial weights: those that ship with the package, or random ones."""

from functools import cache
from importlib.resources import files

import torch
from torch import Tensor, nn

from service.learning.modules import WIDTH, Weights
from shared.features.augmented_state import FEATURES, LEVEL_FEATURES
from shared.wire.schemas import Features, Init

# The weights of preset `paper` by velocity level; preset `reach` has none.
_LEVEL_TENSORS = ("velocity.out.weight", "velocity.out.bias")


def initial_weights(init: Init, preset: Features, levels: int, seed: int) -> Weights:
    """The weights of :func:`initial_parameters`; all missions share the pretrained ones."""
    return _pretrained(preset, levels) if init == "pretrained" else _weights(init, preset, levels, seed)


def initial_parameters(init: Init, preset: Features, levels: int, seed: int) -> dict[str, Tensor]:
    """Parameters by name, in the modules' order, for velocities 0..levels - 1, pretrained, or random by seed.

    The shipped weights have 0..14 m/s; a scenario with a lower limit uses the first levels.
    """
    if init == "random":
        return _random(preset, levels, seed)
    return {k: v[:levels] if preset == "paper" and k in _LEVEL_TENSORS else v for k, v in _packaged(preset).items()}


@cache
def _pretrained(preset: Features, levels: int) -> Weights:
    return _weights("pretrained", preset, levels, seed=0)


def _weights(init: Init, preset: Features, levels: int, seed: int) -> Weights:
    return Weights.of(preset, {k: v.numpy() for k, v in initial_parameters(init, preset, levels, seed).items()})


def _random(preset: Features, levels: int, seed: int) -> dict[str, Tensor]:
    """As torch draws the parameters of linear layers; its own generator does not change."""
    features = FEATURES[preset]
    level_features, outputs = (1, levels) if preset == "paper" else (LEVEL_FEATURES, 1)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        layers = {
            "attention.query": nn.Linear(features, WIDTH, bias=False),
            "attention.key": nn.Linear(features, WIDTH, bias=False),
            "attention.value": nn.Linear(features, WIDTH, bias=False),
            "attention.score": nn.Linear(WIDTH, 1),
            "velocity.hidden": nn.Linear(WIDTH + level_features, WIDTH),
            "velocity.out": nn.Linear(WIDTH, outputs),
        }
    return {f"{name}.{key}": p for name, layer in layers.items() for key, p in layer.state_dict().items()}


@cache
def _packaged(preset: Features) -> dict[str, Tensor]:
    with files("service").joinpath("checkpoints", f"{preset}.pt").open("rb") as file:
        checkpoint = torch.load(file, weights_only=True)
    if checkpoint["features"] != preset:
        raise ValueError(f"checkpoints/{preset}.pt has modules of the feature preset {checkpoint['features']}")
    weights: dict[str, Tensor] = checkpoint["weights"]
    return weights

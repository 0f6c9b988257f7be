"""A mission's initial weights: those that ship with the package, or random ones."""

import math
from functools import cache
from importlib.resources import files

import numpy as np

from service.learning.modules import WIDTH, Weights
from service.learning.softmax_means import Array
from shared.features.augmented_state import FEATURES, LEVEL_FEATURES
from shared.wire.schemas import Features, Init

# The weights of preset `paper` by velocity level; preset `reach` has none.
_LEVEL_ARRAYS = ("velocity.out.weight", "velocity.out.bias")


def initial_weights(init: Init, preset: Features, levels: int, seed: int) -> Weights:
    """The weights of :func:`initial_parameters`; all missions share the pretrained ones."""
    if init == "pretrained":
        return _pretrained(preset, levels)
    return Weights.of(preset, initial_parameters(init, preset, levels, seed))


def initial_parameters(init: Init, preset: Features, levels: int, seed: int) -> dict[str, Array]:
    """Parameters by name, in the modules' order, for velocities 0..levels - 1, pretrained, or random by seed.

    The shipped weights have 0..14 m/s; a scenario with a lower limit uses the first levels.
    """
    if init == "random":
        return _random(preset, levels, seed)
    return {k: v[:levels] if preset == "paper" and k in _LEVEL_ARRAYS else v for k, v in _packaged(preset).items()}


@cache
def _pretrained(preset: Features, levels: int) -> Weights:
    return Weights.of(preset, initial_parameters("pretrained", preset, levels, seed=0))


def _random(preset: Features, levels: int, seed: int) -> dict[str, Array]:
    """As torch's linear layers draw theirs after the same seed, bit for bit: uniform within ``1 / sqrt(inputs)``."""
    features = FEATURES[preset]
    level_features, outputs = (1, levels) if preset == "paper" else (LEVEL_FEATURES, 1)
    shapes: dict[str, tuple[int, ...]] = {
        **{f"attention.{name}.weight": (WIDTH, features) for name in ("query", "key", "value")},
        "attention.score.weight": (1, WIDTH),
        "attention.score.bias": (1,),
        "velocity.hidden.weight": (WIDTH, WIDTH + level_features),
        "velocity.hidden.bias": (WIDTH,),
        "velocity.out.weight": (outputs, WIDTH),
        "velocity.out.bias": (outputs,),
    }
    # Of the seed, torch uses 32 bits; of each number, as many bits as a float32 has digits.
    twister = np.random.RandomState(seed % 2**32)
    parameters, limit = {}, 0.0
    for name, shape in shapes.items():
        if len(shape) == 2:
            limit = float(np.float32(1 / math.sqrt(shape[1])))
        bits = twister.randint(0, 2**32, shape, dtype=np.uint32) % 2**24
        parameters[name] = (bits / 2**24 * (2 * limit) - limit).astype(np.float32)
    return parameters


@cache
def _packaged(preset: Features) -> dict[str, Array]:
    with files("service").joinpath("checkpoints", f"{preset}.npz").open("rb") as file, np.load(file) as checkpoint:
        weights = dict(checkpoint)
    if (own := weights.pop("features").item()) != preset:
        raise ValueError(f"checkpoints/{preset}.npz has modules of the feature preset {own}")
    return weights

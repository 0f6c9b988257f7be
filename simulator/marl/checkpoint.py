"""Trained weights in a file: what they are for, how they were made, and the network that they make."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, field
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from shared.scenario import Scenario
from simulator.errors import UsageError
from simulator.marl.networks import two_heads


class Misfit(UsageError, ValueError):
    """The weights are for scenarios of another size; a command tells it in one line, as it does any bad use."""


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """Weights of :func:`simulator.marl.networks.two_heads` in float32, and where they come from.

    Attributes:
        scenario: that they were trained in.
        episodes, seed: missions flown in training, and the seed of it.
        command: that made them.
        version: of this package, then.
        weights: the network's ``state_dict``.
    """

    scheme: str
    scenario: Scenario
    episodes: int
    seed: int
    command: str
    version: str
    weights: dict[str, Tensor] = field(repr=False)

    def save(self, path: Path) -> None:
        """Write it whole or not at all."""
        write({**asdict(self), "scenario": self.scenario.model_dump_json()}, path)

    @classmethod
    def load(cls, path: Path) -> Checkpoint:
        """Read one.

        Raises:
            ValueError: the file holds no such checkpoint.
            OSError: it cannot be read.
        """
        held = read(path)
        try:
            return cls(**{**held, "scenario": Scenario.model_validate_json(held["scenario"])})
        except (KeyError, TypeError, ValueError):
            raise ValueError(f"{path} holds no trained policy: train one with `aicvds train`") from None

    def network(self, scenario: Scenario) -> nn.Module:
        """The network, for missions of a scenario.

        Raises:
            Misfit: the network was trained for other numbers of sensors, UAVs or velocities.
        """
        for name in ("sensors", "uavs", "max_velocity"):
            trained, asked = getattr(self.scenario, name), getattr(scenario, name)
            if trained != asked:
                raise Misfit(
                    f"{self.scheme} was trained for {name} {trained}, scenario {scenario.name} has {asked}: "
                    f"train one with `aicvds train {self.scheme} --scenario {scenario.name}`"
                )
        network = two_heads(scenario)
        network.load_state_dict(self.weights)
        return network.eval()


def shipped(scheme: str) -> Checkpoint:
    """The checkpoint of a scheme that comes with the package."""
    with as_file(files("simulator").joinpath("checkpoints", f"{scheme}.pt")) as path:
        return Checkpoint.load(path)


def write(content: dict[str, Any], path: Path) -> None:
    """Tensors and plain values to a file, which is there whole or as it was before, even after a power cut."""
    path.parent.mkdir(parents=True, exist_ok=True)
    half = path.with_name(f"{path.name}.part")
    with half.open("wb") as file:
        torch.save(content, file)
        file.flush()
        os.fsync(file.fileno())
    half.replace(path)


def read(path: Path) -> dict[str, Any]:
    """What ``write`` wrote; runs no code from the file.

    Raises:
        ValueError: the file is none of ours.
        OSError: it cannot be read.
    """
    try:
        with path.open("rb") as file:
            held: dict[str, Any] = torch.load(file, weights_only=True)
    except OSError:
        raise
    except Exception as error:
        raise ValueError(f"{path} is no checkpoint of `aicvds train` ({type(error).__name__})") from None
    return held

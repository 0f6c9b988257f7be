"""Trained weights in a file, with their scenario and their origin, and the network made from them."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, field
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from lab.marl.networks import network_of
from shared.world.scenario import Scenario
from simulator.errors import UsageError


class CheckpointMismatch(UsageError, ValueError):
    """The weights are for scenarios of another size."""


@dataclass(frozen=True, eq=False)
class PolicyCheckpoint:
    """Weights of :func:`lab.marl.networks.network_of` in float32, and their origin.

    Attributes:
        scenario: of the training.
        episodes, seed: number of training missions, and the training's seed.
        command: the command line of the training.
        version: of this package at the training.
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
        """Write the checkpoint atomically."""
        write({**asdict(self), "scenario": self.scenario.model_dump_json()}, path)

    @classmethod
    def load(cls, path: Path) -> PolicyCheckpoint:
        """Read a checkpoint.

        Raises:
            ValueError: the file contains no such checkpoint.
            OSError: the file cannot be read.
        """
        content = read(path)
        try:
            return cls(**{**content, "scenario": Scenario.model_validate_json(content["scenario"])})
        except (KeyError, TypeError, ValueError):
            raise ValueError(f"{path} has no trained policy: train one with `python -m lab train`") from None

    def network(self, scenario: Scenario) -> nn.Module:
        """The network for missions of a scenario.

        Raises:
            CheckpointMismatch: the network was trained for other numbers of sensors, UAVs or velocities.
        """
        for name in ("sensors", "uavs", "max_velocity"):
            trained, requested = getattr(self.scenario, name), getattr(scenario, name)
            if trained != requested:
                preset, changed, _ = scenario.name.partition("_changed_")
                changes = " with the same --sensors, --uavs and --set" if changed else ""
                raise CheckpointMismatch(
                    f"{self.scheme} was trained for {name} {trained}, scenario {scenario.name} has {requested}: "
                    f"train one with `python -m lab train {self.scheme} --scenario {preset}`{changes}"
                )
        network = network_of(self.scheme, scenario)
        network.load_state_dict(self.weights)
        return network.eval()


def shipped(scheme: str) -> PolicyCheckpoint:
    """The checkpoint of a scheme that comes with the package."""
    with as_file(files("lab.marl").joinpath("checkpoints", f"{scheme}.pt")) as path:
        return PolicyCheckpoint.load(path)


def write(content: dict[str, Any], path: Path) -> None:
    """Write tensors and plain values to a file atomically, even across a power cut."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.part")
    with part.open("wb") as file:
        torch.save(content, file)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)


def read(path: Path) -> dict[str, Any]:
    """Read a file of ``write`` without running code from it.

    Raises:
        ValueError: the file is no checkpoint.
        OSError: the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            content: dict[str, Any] = torch.load(file, weights_only=True)
    except OSError:
        raise
    except Exception as error:
        raise ValueError(f"{path} is no checkpoint of `python -m lab train` ({type(error).__name__})") from None
    return content

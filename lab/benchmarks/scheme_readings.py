"""The losses of EOF and WQCS on scenario `paper` under the readings that the paper's text allows.

    python -m lab.benchmarks.scheme_readings
    python -m lab.benchmarks.scheme_readings --seeds 3

EOF varies by how a queue's growth is observed and by the number that stands for the channel's quality; both schemes
vary by the velocity within the paper's two ranges, by the order among the UAVs (each for itself, or without the sensors
taken in the step), and by the sensors to choose from. It prints each reading's lost packets with a 95% bootstrap
interval over worlds, those of the policies `eof` and `wqcs` first, and writes the same as JSON. A reading takes some
two seconds at 30 seeds.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import tyro

from lab.experiments.intervals import interval
from shared.world.channel import FloatArray, best_gain_db, whole_rate_bps
from shared.world.scenario import SCENARIOS
from simulator.flying.flight import rollout
from simulator.policies.hand_written import EarliestOverflowFirst, WeightedQueueChannel, free_sensors
from simulator.policies.registry import Policy
from simulator.world.environment import PipelineWorld
from simulator.world.observation import Observation

PAPER = SCENARIOS["paper"]
# Velocities beyond 50 m of the sensor and within: those of the policy, or one for each range.
VELOCITIES = {"by distance": None, "14 or 7": (14, 7), "11 or 4": (11, 4), "8 or 1": (8, 1)}


@dataclass(frozen=True)
class Readings:
    """Fly every reading."""

    seeds: int = 30
    """Worlds: seeds 0 to N - 1."""
    out: Path = Path("runs/scheme_readings.json")
    """Where to write the figures."""


class Reading(EarliestOverflowFirst):
    """One reading of EOF, or of WQCS where ``growth`` is None."""

    def __init__(self, growth: str | None, channel: str, velocity: str, coordinated: bool, among: str) -> None:
        super().__init__(coordinated)
        self._growth_of, self._channel, self._velocity, self._among = growth, channel, VELOCITIES[velocity], among

    def score(self, uav: int, observation: Observation) -> FloatArray:
        """The priority of every sensor, shape ``(J,)``."""
        gain = observation["channel_gain"]
        quality = {
            "power gain": 10.0 ** (gain / 10.0),
            "dB, 0 to 1": np.clip(
                (gain + PAPER.path_loss_limit_db) / (best_gain_db(PAPER) + PAPER.path_loss_limit_db), 0, 1
            ),
            "rate": whole_rate_bps(-gain, PAPER),
        }[self._channel]
        if self._growth_of is None:
            return np.asarray(observation["queue"] * quality)
        before = self._growth[uav].copy(), self._queue[uav].copy(), self._heard[uav].copy()
        super().score(uav, observation)
        if self._growth_of == "newest change":
            change = (observation["queue"] - before[1]) / np.maximum(observation["last_heard"] - before[2], 1)
            new = (before[2] >= 0) & (observation["last_heard"] > before[2])
            self._growth[uav] = np.where(new, np.maximum(change, 1e-3), before[0])
        elif self._growth_of == "mean arrivals":
            self._growth[uav] = PAPER.mean_arrival_rate
        room = np.maximum(PAPER.queue_capacity - observation["queue"], 1e-3)
        return np.asarray(quality * self._growth[uav] / room)

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
        """Sensor and velocity."""
        sensor, velocity = super().decide(uav, observation, taken)
        if self._among == "heard":
            known = taken if self._coordinated else frozenset[int]()
            among = free_sensors(len(observation["queue"]), known) & (observation["last_heard"] >= 0)
            if among.any():
                sensor = int(np.argmax(np.where(among, self.score(uav, observation), -np.inf)))
        if self._velocity is not None:
            away = np.hypot(*(observation["sensor_position"][sensor] - observation["position"]))
            velocity = self._velocity[0] if away > 50.0 else self._velocity[1]
        return sensor, velocity


def readings() -> dict[str, Policy]:
    """Every reading by its description."""
    found: dict[str, Policy] = {"eof": EarliestOverflowFirst(), "wqcs": WeightedQueueChannel()}
    found |= {"eof_coordinated": EarliestOverflowFirst(True), "wqcs_coordinated": WeightedQueueChannel(True)}
    growths, channels = ("newest rise", "newest change", "mean arrivals"), ("power gain", "dB, 0 to 1", "rate")
    for growth, channel, velocity in product(growths, channels, ("by distance", "14 or 7")):
        found[f"EOF: {growth}; {channel}; {velocity}"] = Reading(growth, channel, velocity, False, "in reach")
    for velocity, coordinated, among in product(VELOCITIES, (False, True), ("in reach", "heard")):
        order = "coordinated" if coordinated else "each for itself"
        found[f"WQCS: {velocity}; {order}; {among}"] = Reading(None, "rate", velocity, coordinated, among)
    return found


def main(options: Readings) -> None:
    """Fly, print and write."""
    figures = {}
    for name, policy in readings().items():
        world = PipelineWorld(PAPER)
        lost = [sum(t.lost_packets for t in rollout(world, policy, seed)) for seed in range(options.seeds)]
        figures[name] = interval(lost).model_dump()
        print(
            f"{name}: {figures[name]['mean']:.1f} [{figures[name]['low']:.0f}, {figures[name]['high']:.0f}]", flush=True
        )
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Readings, description=__doc__))

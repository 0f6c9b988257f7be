"""Batches of worlds for training: drawn from seeds, with checked actions and the true state for critics."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared.world.channel import IntArray
from shared.world.scenario import Scenario
from simulator.world.batch import BatchStep, Draw, VectorWorld, stacked
from simulator.world.observation import Observation


def drawn(scenario: Scenario, seeds: Sequence[int]) -> Draw:
    """The worlds of these seeds."""
    return stacked([Draw.one(scenario, np.random.SeedSequence(int(seed))) for seed in seeds])


def state_of(worlds: VectorWorld) -> NDArray[np.float32]:
    """The true state of B worlds, flat float32 of shape ``(B, 1 + 2 I + 4 J)``.

    In this order: step / T; UAV positions / area side (x, y of ``uav_0``, ...); sensor positions / area side (x, y of
    sensor 0, ...); queues / W; batteries / initial battery.

    Raises:
        ValueError: before the first ``reset``.
    """
    if not hasattr(worlds, "sensors"):
        raise ValueError("state before reset")
    scenario, sensors = worlds.scenario, worlds.sensors
    side, count = scenario.area_m, len(sensors.queue)
    parts = (
        np.full((count, 1), worlds.steps_flown / scenario.steps),
        (worlds.fleet.positions / side).reshape(count, -1),
        (sensors.positions / side).reshape(count, -1),
        sensors.queue / scenario.queue_capacity,
        sensors.battery / scenario.battery_j,
    )
    return np.concatenate(parts, axis=1).astype(np.float32)


def events_of(outcome: BatchStep) -> NDArray[np.float32]:
    """The paper's P_l of each world, float32 ``(B,)``: failed transmissions plus overflowing sensors."""
    return np.asarray(outcome.failed.sum(axis=1) + outcome.overflows, dtype=np.float32)


class TrainingWorlds(VectorWorld):
    """:class:`VectorWorld` by seeds.

    Raises:
        ValueError: ``step`` before ``reset`` or past step T, or actions of another shape or out of bounds.
    """

    def reset(self, seeds: Sequence[int]) -> Observation:
        """Draw one world a seed, and return the first observations."""
        return self.start(drawn(self.scenario, seeds))

    def step(self, sensors: ArrayLike, velocities: ArrayLike) -> tuple[Observation, BatchStep]:
        """Fly one step of every world.

        Args:
            sensors: the sensor that each UAV collects from, integers ``(B, I)``.
            velocities: of each UAV, m/s, integers ``(B, I)``.
        """
        if not hasattr(self, "sensors"):
            raise ValueError("step before reset")
        if self.steps_flown == self.scenario.steps:
            raise ValueError("step after the mission's end: reset first")
        chosen = self._checked("sensors", np.asarray(sensors), self.scenario.sensors - 1)
        return self.fly(chosen, self._checked("velocities", np.asarray(velocities), self.scenario.max_velocity))

    def _checked(self, name: str, values: IntArray, last: int) -> IntArray:
        shape = self.fleet.start_m.shape
        if values.shape != shape or values.dtype.kind not in "iu":
            raise ValueError(f"{name} of shape {values.shape} and type {values.dtype}, not integers {shape}")
        if values.min() < 0 or values.max() > last:
            raise ValueError(f"{name} are not all in 0..{last}")
        return values.astype(np.int64, copy=False)

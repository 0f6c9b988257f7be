"""The losses that a fleet's actions are expected to have, with the exact distribution of every queue."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence

import numpy as np

from shared.channel import IntArray
from shared.fleetplan.problem import FleetProblem
from shared.fleetplan.queue_chains import Floats, QueueChains

# A sensor's visits in the order of their steps: the step, the levels that it moves, and the chance of its link.
SensorVisits = tuple[tuple[int, int, float], ...]
Visits = dict[int, SensorVisits]


class ExpectedLoss:
    """The expected loss of plans of one problem over uncertain links: the mean over links and arrivals.

    A link holds with its chance, whatever earlier ones did. Batteries are assumed to last. Where the problem prices
    lateness, a visit saves it by its chance. Sensors lose packets independently of each other, and a search changes few
    sensors' visits at a time, so what is computed of a sensor's visits is kept.

    Args:
        problem: with ``chains``.

    Attributes:
        near: by UAV, the sensors that it may reach within the horizon.
        ends: shape ``(J, G + 1, K)``, the expected losses after the horizon by the level and the stage.
    """

    def __init__(self, problem: FleetProblem) -> None:
        assert problem.chains is not None
        self.problem = problem
        self.chains: QueueChains = problem.chains
        self.count = self.chains.start.shape[1] - 1
        self.ends: Floats = np.ascontiguousarray(self.chains.after.transpose(1, 2, 0))
        sums = np.arange(problem.horizon * problem.scenario.max_velocity + 1)
        self._tables = [self._links(uav, sums) for uav in range(problem.uavs)]
        self.near = [np.flatnonzero(np.any([c.any(axis=0) for _, c in tables], axis=0)) for tables in self._tables]
        late = problem.late
        # late_until[s, e]: the price of the steps before e.
        self.late_until = None if late is None else np.pad(np.cumsum(late, axis=1), ((0, 0), (1, 0), (0, 0)))
        self._values: dict[Hashable, Floats] = {}
        self._odds: dict[Hashable, Floats] = {}

    def _links(self, uav: int, sums: IntArray) -> list[tuple[IntArray, Floats]]:
        problem, found = self.problem, []
        same = problem.links is None or len(problem.links[uav]) == 1
        for step in range(1 if same else problem.horizon):
            packets = problem.packets(uav, sums, step)
            levels = np.clip(np.rint(packets / self.chains.level), packets > 0, self.count).astype(np.int64)
            chance = np.where(packets > 0, problem.chance(uav, sums, step), 0.0)
            found.append((levels, chance.astype(np.float32)))
        return found

    def links(self, uav: int, step: int) -> tuple[IntArray, Floats]:
        """The levels that a transfer moves, and the chance that it does, ``(C, J)`` by the sum of velocities."""
        tables = self._tables[uav]
        return tables[step if len(tables) > 1 else 0]

    def visits(self, actions: IntArray, without: int = -1) -> Visits:
        """The visits of actions ``(H, I, 2)``, by sensor; of several UAVs in a step the first has the sensor."""
        flown = np.cumsum(actions[:, :, 1], axis=0).tolist()
        found: dict[int, list[tuple[int, int, float]]] = {}
        for step, sensors in enumerate(actions[:, :, 0].tolist()):
            for uav, sensor in enumerate(sensors):
                levels, chance = self.links(uav, step)
                at = flown[step][uav], sensor
                if uav == without or not (moved := levels.item(at)):
                    continue
                earlier = found.setdefault(sensor, [])
                if not earlier or earlier[-1][0] != step:
                    earlier.append((step, moved, chance.item(at)))
        return {sensor: tuple(visits) for sensor, visits in found.items()}

    def stage(self, actions: IntArray, without: int = -1) -> IntArray:
        """Each sensor's stage after the horizon, ``(J,)``."""
        after = self.problem.afterwards
        if after is None:
            return np.zeros(self.problem.sensors, dtype=np.int64)
        stage = np.full(self.problem.sensors, len(self.chains.after) - 1)
        for uav, summed in enumerate(actions[:, :, 1].sum(axis=0).tolist()):
            if uav != without:
                stage = np.minimum(stage, after.stages[uav][summed])
        return stage

    def of(self, actions: IntArray) -> float:
        """The expected loss of actions ``(H, I, 2)`` and the price of their lateness, packets."""
        visits = self.visits(actions)
        return float(self.start(self.values(visits, self.stage(actions)))) + self._late(visits)

    def start(self, values: Floats) -> np.float32:
        """The expected loss by the values before step 0."""
        return np.float32((self.chains.start * values[:, 0]).sum())

    def values(self, visits: Visits, stage: IntArray) -> Floats:
        """The expected losses to the end by the level, ``(J, H + 2, G + 1)``, for visits and stages ``(J,)``.

        The first entry is before step 0; entry t + 1 is after the transfers of step t.
        """
        keys = [(sensor, kind, visits.get(sensor, ())) for sensor, kind in enumerate(stage.tolist())]
        self._keep(self._values, keys, lambda new: self._backward(new, visits, stage))
        return np.stack([self._values[key] for key in keys])

    def odds(self, sensors: IntArray, visits: Visits) -> Floats:
        """The odds of the levels of these sensors' queues after the horizon, ``(n, G + 1)``."""
        keys = [(sensor, visits.get(sensor, ())) for sensor in sensors.tolist()]
        self._keep(self._odds, keys, lambda new: self._forward(new, visits))
        return np.array([self._odds[key] for key in keys], dtype=np.float32).reshape(len(keys), self.count + 1)

    @staticmethod
    def _keep(kept: dict[Hashable, Floats], keys: Sequence[tuple[Hashable, ...]], of: Callable[..., Floats]) -> None:
        """Compute what is missing of each sensor's key, for all missing sensors at once."""
        if new := [key for key in keys if key not in kept]:
            kept.update(zip(new, of([key[0] for key in new]), strict=True))

    def _backward(self, sensors: list[int], visits: Visits, stage: IntArray) -> Floats:
        """The values of these sensors, ``(n, H + 2, G + 1)``."""
        chains, horizon = self.chains, self.problem.horizon
        found = np.empty((len(sensors), horizon + 2, self.count + 1), dtype=np.float32)
        value = chains.after[stage[sensors], sensors]
        lost, arrive = chains.lost[:, sensors], chains.arrive[:, sensors]
        at = _by_step(sensors, visits)
        for step in range(horizon - 1, -1, -1):
            value = lost[step] + (arrive[step] @ value[..., None])[..., 0]
            found[:, step + 1] = value
            for row, levels, chance in at.get(step, ()):
                moved = value[row][np.maximum(np.arange(self.count + 1) - levels, 0)]
                value[row] += np.float32(chance) * (moved - value[row])
        found[:, 0] = value
        return found

    def _forward(self, sensors: list[int], visits: Visits) -> Floats:
        """The odds after the horizon of these sensors' levels, ``(n, G + 1)``."""
        odds, at = self.chains.start[sensors], _by_step(sensors, visits)
        for step in range(self.problem.horizon):
            if now := at.get(step):
                rows, levels, chances = (np.array(column) for column in zip(*now, strict=True))
                odds[rows] = self.chains.served(odds[rows], levels, chances.astype(np.float32))
            odds = (odds[:, None] @ self.chains.arrive[step, sensors])[:, 0]
        return odds

    def _late(self, visits: Visits) -> float:
        """The price of lateness."""
        late = self.problem.late
        if late is None:
            return 0.0
        price = late[0].copy()
        for sensor, served in visits.items():
            for step, _, chance in served:
                price[step:, sensor] -= chance * (price[step:, sensor] - late[step + 1, step:, sensor])
        return float(price.sum())


def _by_step(sensors: list[int], visits: Visits) -> dict[int, list[tuple[int, int, float]]]:
    """By step, the visits of these sensors: the sensor's place among them, the levels and the chance."""
    found: dict[int, list[tuple[int, int, float]]] = {}
    for row, sensor in enumerate(sensors):
        for step, levels, chance in visits.get(sensor, ()):
            found.setdefault(step, []).append((row, levels, chance))
    return found

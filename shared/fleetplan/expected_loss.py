"""The losses that a fleet's actions are expected to have, with the exact distribution of every queue."""

from __future__ import annotations

import numpy as np

from shared.channel import IntArray
from shared.fleetplan.problem import FleetProblem
from shared.fleetplan.queue_chains import Floats, QueueChains

# By sensor, the levels that a visit moves and the chance of its link.
Visits = dict[int, tuple[int, float]]


class ExpectedLoss:
    """The expected loss of plans of one problem over uncertain links: the mean over links and arrivals.

    A link holds with its chance, whatever earlier ones did. Batteries are assumed to last. Where the problem prices
    lateness, a visit saves it by its chance.

    Args:
        problem: with ``chains``.
    """

    def __init__(self, problem: FleetProblem) -> None:
        assert problem.chains is not None
        self.problem = problem
        self.chains: QueueChains = problem.chains
        self.count = self.chains.start.shape[1] - 1
        sums = np.arange(problem.horizon * problem.scenario.max_velocity + 1)
        self._tables = [self._links(uav, sums) for uav in range(problem.uavs)]
        late = problem.late
        # late_until[s, e]: the price of the steps before e.
        self.late_until = None if late is None else np.pad(np.cumsum(late, axis=1), ((0, 0), (1, 0), (0, 0)))

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

    def visits(self, actions: IntArray, without: int = -1) -> list[Visits]:
        """The visits of each step of actions ``(H, I, 2)``; of several UAVs the first has the sensor."""
        flown = np.cumsum(actions[:, :, 1], axis=0)
        found: list[Visits] = []
        for step in range(len(actions)):
            now: Visits = {}
            for uav in range(self.problem.uavs):
                levels, chance = self.links(uav, step)
                at = flown[step, uav], actions[step, uav, 0]
                if uav != without and levels[at]:
                    now.setdefault(int(at[1]), (int(levels[at]), float(chance[at])))
            found.append(now)
        return found

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

    def ends(self, stage: IntArray) -> Floats:
        """The expected losses after the horizon by the level, ``(..., J, G + 1)``, for stages ``(..., J)``."""
        return np.asarray(self.chains.after[stage, np.arange(self.problem.sensors)])

    def of(self, actions: IntArray) -> float:
        """The expected loss of actions ``(H, I, 2)`` and the price of their lateness, packets."""
        visits = self.visits(actions)
        return float((self.chains.start * self.values(visits, self.stage(actions))[0]).sum()) + self._late(visits)

    def values(self, visits: list[Visits], stage: IntArray) -> list[Floats]:
        """The expected losses to the end by the level, ``(J, G + 1)``, before each step and after its transfers.

        The first entry is before step 0; entry t + 1 is after the transfers of step t.
        """
        chains = self.chains
        value, found = self.ends(stage), []
        for step in range(len(visits) - 1, -1, -1):
            value = chains.lost[step] + (chains.arrive[step] @ value[..., None])[..., 0]
            found.append(value)
            value = value.copy()
            for sensor, (levels, chance) in visits[step].items():
                moved = value[sensor][np.maximum(np.arange(self.count + 1) - levels, 0)]
                value[sensor] += np.float32(chance) * (moved - value[sensor])
        return [value, *found[::-1]]

    def _late(self, visits: list[Visits]) -> float:
        """The price of lateness."""
        if self.problem.late is None:
            return 0.0
        price = self.problem.late[0].copy()
        for step, now in enumerate(visits):
            for sensor, (_, chance) in now.items():
                saved = price[step:, sensor] - self.problem.late[step + 1, step:, sensor]
                price[step:, sensor] -= chance * saved
        return float(price.sum())

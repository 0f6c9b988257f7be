"""Plans over uncertain links, improved one action at a time by their exact price.

The formulation of :mod:`shared.fleetplan.formulation` knows one tier of chances for each sensor and step. Here every
place has its own chance.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from shared.channel import IntArray
from shared.fleetplan.problem import FleetProblem, price
from shared.fleetplan.solver import Plan

# Each pass tries every action of the plan; the last pass improves it by less than this, packets.
_PASSES = 2
_LEAST_GAIN = 0.02


def refined(problem: FleetProblem, plan: Plan, seconds: float = math.inf) -> Plan:
    """The plan after exchanges of single actions, never worse.

    In the order of the steps and of the UAVs, an action is exchanged for every sensor that the UAV can serve there: it
    flies to the place of the highest chance from which the actions before and after it still lead on. An exchange that
    lowers :func:`~shared.fleetplan.problem.price` stays.

    Args:
        problem: with ``chances``.
        plan: of the problem.
        seconds: limit of the wall clock; the plan then depends on the machine.
    """
    until = time.perf_counter() + seconds
    lost, cost = price(problem, plan.actions)
    best, begun = plan.actions, math.inf
    for _ in range(_PASSES):
        if begun - cost < _LEAST_GAIN:
            break
        begun = cost
        for step in range(problem.horizon):
            for uav in range(problem.uavs):
                if step < len(problem.fixed.get(uav, ())):
                    continue
                for actions in _exchanges(problem, best, step, uav):
                    if time.perf_counter() > until:
                        return replace(plan, actions=best, lost_packets=lost, objective=cost)
                    now, costs = price(problem, actions)
                    if costs < cost - 1e-6:
                        best, lost, cost = actions, now, costs
    return replace(plan, actions=best, lost_packets=lost, objective=cost)


def _exchanges(problem: FleetProblem, actions: IntArray, step: int, uav: int) -> Iterator[IntArray]:
    """The actions with that one exchanged, for each sensor that another UAV leaves free in this step."""
    flown = np.cumsum(actions[:, uav, 1])
    start = int(flown[step - 1]) if step else 0
    sums = start + problem.levels
    last = step + 1 == len(flown)
    if not last:
        sums = sums[np.isin(flown[step + 1] - sums, problem.levels)]
    links, chances = problem.packets(uav, sums, step), problem.chance(uav, sums, step)
    chances = np.where(links > 0, chances, 0.0)
    servable = np.asarray(chances.any(axis=0))
    servable[np.delete(actions[step, :, 0], uav)] = False
    if problem.usable is not None:
        servable &= problem.usable[step]
    # Of equal chances the place nearest to the present one.
    nearer = -1e-6 * np.abs(sums - flown[step])
    for sensor in np.flatnonzero(servable).tolist():
        place = int(sums[np.argmax(chances[:, sensor] + nearer)])
        exchanged = actions.copy()
        exchanged[step, uav] = sensor, place - start
        if not last:
            exchanged[step + 1, uav, 1] = flown[step + 1] - place
        yield exchanged

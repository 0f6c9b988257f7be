"""A quick plan, as the start of a search and as a fallback: in every step each UAV looks one step ahead."""

import math

import numpy as np

from shared.planning.fleet_problem import FleetProblem
from shared.world.channel import FloatArray, IntArray
from shared.world.scenario import Scenario
from shared.world.step_rule import arrive
from shared.world.urgency import urgency_of, with_bonus

_erf = np.frompyfunc(math.erf, 1, 1)


def look_ahead(problem: FleetProblem) -> IntArray:
    """Actions ``(H, I, 2)`` that begin with the fixed ones and continue greedily.

    Step by step and in the order of their indices, every UAV takes the sensor and the velocity of greatest
    ``U_j min(q_j, packets movable from the new position) + 0.5 v``, with the urgency
    ``U_j = q_j / 2W + P(overflow) / 2`` of :mod:`shared.world.urgency`, with a normal of the same mean for its Poisson.
    No two UAVs take a sensor in the same step. Batteries are assumed to last. A sensor's urgent packets
    have the weight of its lost ones, and for a sensor in reach the price of being overdue counts too.
    """
    world = problem.scenario
    window = max(1, math.ceil(world.overflow_horizon_steps))
    actions = np.zeros((problem.horizon, problem.uavs, 2), dtype=np.int64)
    flown = np.zeros(problem.uavs, dtype=np.int64)
    queue: FloatArray = problem.queue.astype(np.float64)
    since = np.zeros(problem.sensors, dtype=np.int64)
    every, reached = np.arange(problem.sensors), problem.reached
    for step in range(problem.horizon):
        overflow = _overflow(queue, problem.arrivals[step : step + window].mean(axis=0), world)
        urgent = urgency_of(queue, overflow, world)
        late = None if problem.late is None else problem.late[since, step, every]
        if problem.weights is not None:
            urgent = urgent * problem.weights
        fixed_now = {uav: fixed[step] for uav, fixed in problem.fixed.items() if step < len(fixed)}
        free = np.ones(problem.sensors, dtype=np.bool_) if problem.usable is None else problem.usable[step].copy()
        free[[int(sensor) for sensor, _ in fixed_now.values()]] = False
        moved = np.zeros(problem.sensors)
        for uav in range(problem.uavs):
            if uav in fixed_now:
                sensor, velocity = fixed_now[uav].tolist()
                packets = _expected(problem, uav, flown[uav] + np.array([velocity]), step)[0]
            else:
                levels = problem.levels[: reached[uav]]
                links = _expected(problem, uav, flown[uav] + levels, step)
                worth = urgent * np.minimum(queue, links) + (0.0 if late is None else late * (links > 0))
                worth = with_bonus(np.where(free, worth, -1.0), levels)
                level, sensor = np.unravel_index(int(worth.argmax()), worth.shape)
                velocity, packets = int(levels[level]), links[level]
                free[sensor] = False
            actions[step, uav] = sensor, velocity
            flown[uav] += velocity
            moved[sensor] = max(moved[sensor], float(packets[sensor]))
        since[moved > 0] = step + 1
        queue, _ = arrive(np.maximum(queue - moved, 0.0), problem.arrivals[step], world.queue_capacity)
    return actions


def _overflow(queue: FloatArray, rate: FloatArray, world: Scenario) -> FloatArray:
    """``P(overflow)`` by the standard library's normal distribution: planning needs no scipy."""
    arrived = np.maximum(rate * world.overflow_horizon_steps, 1e-9)
    z = (arrived - (world.queue_capacity - queue)) / np.sqrt(arrived)
    return np.asarray(0.5 * (1.0 + np.asarray(_erf(z / math.sqrt(2.0)), dtype=np.float64)))


def _expected(problem: FleetProblem, uav: int, velocity: IntArray, step: int) -> FloatArray:
    """The packets that links are expected to move, ``(n, J)``."""
    return problem.packets(uav, velocity, step) * problem.chance(uav, velocity, step)

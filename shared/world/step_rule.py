"""The rule of a step: what the UAVs collect, what arrives, and what overflows.

The world, flown plans and trials with simulated radios use these functions. Where speed needs another form, a property
test compares it with them: the flights of the rollout evaluator (compiled), the costs of the annealing (distributions
of queues) and the constraints of the clairvoyant bound.

In a step UAV i names sensor ``s_i``. Its link holds or not. A link that holds can move ``p_i`` packets in the step,
each for ``w_i`` joules. Sensor j has a queue ``q_j`` of at most W packets and ``e_j`` joules.

1. **Transfers.** A sensor serves one UAV a step: of those that name it the one of the lowest index whose link holds and
   for which the battery pays for a packet, ``a_i = floor(e_j / w_i) >= 1``. With ``j = s_i`` the served UAV moves
   ``m_i = min(q_j, p_i, a_i)`` packets, so that ``q_j <- q_j - m_i`` and ``e_j <- max(0, e_j - m_i w_i)``. Its
   transmission succeeds (f_i = 0) even from an empty queue. Every other transmission fails (f_i = 1) and moves nothing.
2. **Arrivals and overflow.** ``r_j`` packets arrive, ``l_j = max(0, q_j + r_j - W)`` are lost (g_j = 1 if any), and
   ``q_j <- min(W, q_j + r_j)``.

The paper's packet loss P_l of the step, its Eq. (9), is the sum of all f and all g.
"""

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shared.world.channel import FloatArray, IntArray, rate_bps
from shared.world.scenario import Scenario

BoolArray = NDArray[np.bool_]


class Action(NamedTuple):
    """A sensor's ID and a velocity in m/s. An action equals the plain pair, and is stored and sent as a pair."""

    sensor_id: int
    velocity: int


def transfer(
    queue: IntArray, battery: FloatArray, sensor: IntArray, holds: BoolArray, packets: IntArray, joules: FloatArray
) -> tuple[BoolArray, IntArray]:
    """Let I UAVs collect in one step of each world; leading dimensions are those of the worlds.

    Args:
        queue: shape ``(..., J)``, contiguous; changed in place.
        battery: shape ``(..., J)``, contiguous; changed in place.
        sensor: shape ``(..., I)``, the sensor that each UAV names.
        holds: shape ``(..., I)``, whether the link to it holds.
        packets: shape ``(..., I)``, that the link can move in the step.
        joules: shape ``(..., I)``, that the sensor pays for each.

    Returns:
        Whether each transmission succeeds, and the packets moved, ``(..., I)`` each.
    """
    queues, batteries = queue.reshape(-1), battery.reshape(-1)
    at = sensor + _first_sensors(queue.shape)
    charge = batteries[at]
    # The margin is for an energy that the battery has to the last bit.
    affordable = np.floor(charge / joules + 1e-9)
    served = holds & (affordable >= 1)
    same = (sensor[..., :, None] == sensor[..., None, :]) & _earlier(sensor.shape[-1])
    served &= ~np.logical_or.reduce(same & served[..., None, :], axis=-1)
    moved = (np.minimum(np.minimum(queues[at], packets), affordable) * served).astype(np.int64)
    # No sensor is twice among those served.
    which, taken = at[served], moved[served]
    queues[which] -= taken
    batteries[which] = np.maximum(0.0, charge[served] - taken * joules[served])
    return served, moved


@lru_cache
def _first_sensors(shape: tuple[int, ...]) -> IntArray:
    """The place of each world's first sensor among those of all worlds, ``(..., 1)``."""
    return np.arange(0, math.prod(shape), shape[-1]).reshape(*shape[:-1], 1)


@lru_cache
def _earlier(uavs: int) -> BoolArray:
    """Whether UAV k (the column) comes before UAV i (the row)."""
    return np.tri(uavs, k=-1, dtype=np.bool_)


def arrive(queue: Any, arrived: Any, capacity: int) -> tuple[Any, Any]:
    """The queues after a step's arrivals, and the packets lost; arrays of one shape."""
    filled = queue + arrived
    left = np.minimum(filled, capacity)
    return left, filled - left


@lru_cache
def least_joules_a_packet(scenario: Scenario) -> float:
    """The energy of one packet over the shortest link; a sensor with less can transmit nothing."""
    return float(joules_a_packet(rate_bps(0.0, scenario), scenario))


def joules_a_packet(rate_bps: FloatArray, scenario: Scenario) -> FloatArray:
    """The energy of one packet: transmit power times airtime; more than any battery has where there is no rate."""
    return np.asarray(scenario.transmit_power_w * (scenario.packet_bits / np.maximum(rate_bps, 1e-30)))

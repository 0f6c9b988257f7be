"""Orders in the compact prompt: a visit's deadline appears as a queue that overflows at that time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from shared.features.augmented_state import Reach, State
from shared.planning.orders import Guidance
from shared.world.scenario import Scenario
from shared.world.urgency import overflow_probability, urgency_of


def as_queues(
    state: State, reach: Reach, orders: Guidance, step: int, visits: NDArray[np.int64], scenario: Scenario
) -> tuple[State, Reach]:
    """The state and the reach in which wishes for sensors are queues, for an LLM that was trained on queues.

    A sensor with a weight w has w times its packets and arrivals, at most W packets. One to be visited within n steps
    has at least a queue that fills from 0 at its last visit to W when a visit is due: ``W min(1, waited / n)`` packets,
    with W / n arrivals a step.

    Args:
        reach: of the state.
        visits: the step of each sensor's last visit, by sensor ID; -1 for never.
    """
    if not orders.wishes:
        return state, reach
    capacity = float(scenario.queue_capacity)
    weights = orders.weights(scenario.sensors)[state.ids]
    interval = orders.visit_intervals(scenario.sensors)[state.ids]
    waited = np.minimum((step - visits[state.ids]) / interval, 1.0)
    queue = np.maximum(np.minimum(weights * state.queue, capacity), capacity * waited)
    rate = np.maximum(weights * state.rate, capacity / interval)
    overflow = overflow_probability(queue, rate, scenario)
    urgency = urgency_of(queue, overflow, scenario)
    shown = Reach.of(reach.links, np.where(state.able, queue, 0.0), urgency)
    ordered = replace(
        state,
        queue=queue,
        rate=rate,
        overflow=overflow,
        urgency=urgency,
        reach=None if state.reach is None else shown,
    )
    return ordered, shown

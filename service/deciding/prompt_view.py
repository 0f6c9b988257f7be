"""A prompt's view of one UAV's state, and the orders that it follows."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from service.guidance.step_guidance import StepGuidance
from service.mission.mission import Mission
from service.prompting.compact_prompt import CompactTemplate
from shared.features.augmented_state import Reach, State
from shared.planning.orders import Guidance
from shared.world.channel import FloatArray
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


@dataclass(frozen=True, slots=True)
class PromptView:
    """The view of J sensors from which a prompt is written.

    Attributes:
        state, reach: as the prompt shows them. The compact prompt has the orders in them, as queues; the reach is None
            where it is the state's own.
        offered: the reach by which the candidates' velocities are chosen; None if it is the state's own.
        guidance: the guidance for the candidates' velocities in this step.
        added: shape ``(J,)``, packets to add to the worth of each sensor as attention chooses the prompt's rows; None
            where there are no orders.
    """

    state: State
    reach: Reach | None
    offered: Reach | None
    guidance: StepGuidance | None
    added: FloatArray | None

    @classmethod
    def of(cls, mission: Mission, state: State, uav_id: int, step: int, confirmed: StepGuidance | None) -> Self:
        """By the confirmed orders, and with the compact prompt by the LLM's own reading of the note before that.

        An unconfirmed order appears only in the prompt: in mode ``guided`` it affects only the LLM's advice, not the
        candidates. Orders in force stay until the operator confirms others.
        """
        scenario, visits = mission.scenario, mission.records.visits
        added = None if confirmed is None else confirmed.worth.max(axis=0)
        read = mission.guidance.read
        if read is None or not isinstance(mission.template, CompactTemplate):
            return cls(state, None, None, confirmed, added)
        reach = state.reach_ahead(uav_id, scenario)
        shown, seen = as_queues(state, reach, read, step, visits, scenario)
        if mission.mode != "llm":
            return cls(shown, seen, seen if read is mission.guidance.orders else None, confirmed, added)
        guidance = StepGuidance.of(read, state, reach, step, visits, scenario)
        ordered = np.where(guidance.allowed[:, None], seen.worth - reach.worth, -np.inf)
        return cls(shown, seen, seen, guidance, ordered.max(axis=0))

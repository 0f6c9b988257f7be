"""A prompt's view of one UAV's state, and the orders that it follows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from service.guidance.orders_as_queues import as_queues
from service.guidance.step_guidance import StepGuidance
from service.mission.mission import Mission
from service.prompting.compact_prompt import CompactTemplate
from shared.features.augmented_state import Reach, State
from shared.world.channel import FloatArray


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

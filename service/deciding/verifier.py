"""Hard rules for an LLM's answer, whatever it says and whatever made it say so.

They need no judgement: a sensor that is out of the UAV's reach after the step, or whose battery is known to be flat,
brings nothing, and one that another UAV has meanwhile fails. An answer that breaks a rule is overridden by the
LLM-free policy's, with the rule as the reason. In mode ``guided`` no answer decides alone: the rollout evaluator weighs
it there.
"""

from __future__ import annotations

import numpy as np

from service.deciding.attended_state import AttendedState
from service.llm.answers import NoDecision
from shared.world.actions import Action


def verify(state: AttendedState, answer: Action) -> None:
    """Raises :class:`NoDecision` where the answer breaks a rule.

    A sensor out of reach breaks none while nothing that is admissible is in reach at any velocity.
    """
    mission, (sensor, velocity) = state.mission, answer
    if sensor in mission.reservations.of_others(state.step, state.uav_id):
        raise NoDecision("answer_reserved", f"another UAV has sensor {sensor} meanwhile")
    if mission.spec.verify == "off":
        return
    if mission.belief.battery[sensor] <= 0:
        raise NoDecision("rule_battery", f"the battery of sensor {sensor} is flat")
    likely = state.reach.likely
    row = int(np.flatnonzero(state.state.ids == sensor)[0])
    if not likely[velocity, row] and likely[:, state.state.admissible].any():
        raise NoDecision("rule_reach", f"sensor {sensor} is out of reach after a step at {velocity} m/s")

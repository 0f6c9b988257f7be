"""Hard rules for an LLM's answer.

No packets can be collected from a sensor out of the UAV's reach after the step, or with a flat battery, and a
transmission from a sensor that another UAV has reserved fails. The LLM-free policy's action replaces an answer that
breaks a rule, with the rule as the reason. Mode ``guided`` needs no rules: the rollout evaluator weighs each answer.
"""

from __future__ import annotations

import numpy as np

from service.deciding.attended_state import AttendedState
from service.llm.answers import NoDecision
from shared.world.actions import Action


def verify(state: AttendedState, answer: Action) -> None:
    """Raises :class:`NoDecision` if the answer breaks a rule.

    A sensor out of reach is allowed while no admissible sensor is in reach at any velocity.
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

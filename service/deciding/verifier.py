"""Hard rules that an LLM's answer is held to, whatever it says and whoever got it to say so.

They need no judgement: a sensor that is out of the UAV's reach after the step, or whose battery is known to be flat,
brings nothing, and one that another UAV was given meanwhile fails. An answer that breaks one is overridden by the
LLM-free policy's, with the rule as the reason. In mode ``guided`` no answer decides alone: there the critic weighs it.
"""

from __future__ import annotations

import numpy as np

from service.deciding.attended_state import AttendedState
from service.llm.answer_format import NoDecision
from service.mission.mission import Mission
from shared.channel import link_holds
from shared.reach import distances_ahead


def verify(mission: Mission, view: AttendedState, sensor: int, velocity: int) -> None:
    """Raises :class:`NoDecision` where the answer breaks a rule.

    A sensor out of reach breaks none while nothing that is admissible is in reach at any velocity.
    """
    if sensor in mission.reserved(view.step, view.uav_id):
        raise NoDecision("answer_reserved", f"sensor {sensor} was given away meanwhile")
    if mission.spec.verify == "off":
        return
    if mission.belief.battery[sensor] <= 0:
        raise NoDecision("rule_battery", f"the battery of sensor {sensor} is flat")
    state = view.state
    distance = distances_ahead(view.uav_id, state.position, state.progress_m, state.places, mission.scenario)
    row = int(np.flatnonzero(state.ids == sensor)[0])
    if link_holds(distance[velocity, row], mission.scenario):
        return
    if link_holds(distance[:, state.admissible], mission.scenario).any():
        raise NoDecision("rule_reach", f"sensor {sensor} is out of reach after a step at {velocity} m/s")

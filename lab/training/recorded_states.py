"""Recorded decisions, each in the state in which the edge would have made it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from lab.exploration.rollouts import RolloutStep
from service.deciding.attended_state import AttendedState
from service.mission.mission import Mission
from shared.wire.schemas import Outcome
from shared.world.step_rule import Action


def recorded_states(mission: Mission, steps: Iterable[RolloutStep]) -> Iterator[tuple[RolloutStep, AttendedState]]:
    """Each decision of a mission that was recorded, in order, with the state before it.

    The mission takes every report, decision and outcome as in flight, and so learns its links, arrivals and wind as
    there. An outcome comes with the UAV's next report, so that the UAVs that decide between the two do not know it.
    """
    open_outcomes: dict[int, Outcome] = {}
    for number, step in enumerate(steps):
        uav, decision_id = step.request, f"{number:032x}"
        if uav.uav_id in open_outcomes:
            mission.apply(open_outcomes.pop(uav.uav_id))
        mission.observe(uav, uav.step)
        state = AttendedState.of(mission, uav, uav.step)
        yield step, state
        mission.commit(state.pending(decision_id, Action(step.sensor_id, step.velocity)))
        open_outcomes[uav.uav_id] = Outcome(decision_id=decision_id, cost=step.cost, failed=step.failed)

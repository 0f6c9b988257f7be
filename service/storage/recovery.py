"""Reading a mission back: its last checkpoint, and the events since played again on it."""

from __future__ import annotations

from service.config.settings import Settings
from service.mission.events import Decided, Event, Guided, Reported, Settled
from service.mission.idempotency import Answered
from service.mission.mission import Mission
from service.storage.store import StoredMission


def restore_mission(mission_id: str, kept: StoredMission, settings: Settings) -> Mission:
    """The mission as it was after the last event kept, but for its plan, which is made again.

    Raises:
        ValueError: what is kept does not fit together.
    """
    mission = Mission(mission_id, kept.asked_for, settings, kept.spec)
    try:
        if kept.state is not None:
            mission.load_state_dict(kept.state)
            mission.learner.load_state_dict(kept.state["learner"])
        for event in kept.events:
            _play(mission, event)
    except (AttributeError, IndexError, KeyError, RuntimeError, TypeError) as error:
        raise ValueError(f"mission {mission_id} cannot be read back: {error!r}") from error
    return mission


def _play(mission: Mission, event: Event) -> None:
    match event:
        case Reported(step, uav):
            mission.observe(uav, step)
        case Decided(decision, attempt, counsel):
            mission.commit(decision, attempt, counsel)
        case Settled(outcome, taught):
            sample = mission.apply(outcome, for_training=taught)
            if sample is not None and taught:
                mission.learn(sample, outcome.cost)
        case Guided(state):
            mission.restore_guidance(state)
        case Answered():
            mission.idempotent_answers.remember(event)

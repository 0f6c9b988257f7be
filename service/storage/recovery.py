"""Recovery of a mission from the store: its last checkpoint, and the events since then, replayed."""

from service.config.settings import Settings
from service.mission.events import Decided, Event, GuidanceChanged, ReadingsMerged, Reported, Settled
from service.mission.idempotency import Answered
from service.mission.mission import Mission
from service.storage.store import StoredMission


def restore_mission(mission_id: str, stored: StoredMission, settings: Settings) -> Mission:
    """The mission after its last stored event, except for its plan, which is made again.

    Raises:
        ValueError: the stored state and events do not fit together.
    """
    mission = Mission(mission_id, stored.asked_for, settings, stored.spec)
    try:
        if stored.state is not None:
            mission.load_state_dict(stored.state)
            mission.learner.load_state_dict(stored.state["learner"])
        for event in stored.events:
            _replay(mission, event)
    except (AttributeError, IndexError, KeyError, RuntimeError, TypeError) as error:
        raise ValueError(f"mission {mission_id} cannot be restored: {error!r}") from error
    return mission


def _replay(mission: Mission, event: Event) -> None:
    match event:
        case Reported(step, uav):
            mission.observe(uav, step)
        case Decided(decision, attempt, report):
            mission.commit(decision, attempt, report)
        case Settled(outcome, used_for_training):
            sample = mission.apply(outcome, for_training=used_for_training)
            if sample is not None and used_for_training:
                mission.learn(sample, outcome.cost)
        case GuidanceChanged(state):
            mission.restore_guidance(state)
        case Answered():
            mission.idempotent_answers.remember(event)
        case ReadingsMerged(readings):
            mission.take_readings(readings)

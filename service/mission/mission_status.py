"""The answer of ``GET /missions/{id}``."""

from __future__ import annotations

import numpy as np

from service.mission.learned_world_status import learned_world
from service.mission.mission import Mission
from shared.wire.missions import MissionStatus


def status_of(mission: Mission) -> MissionStatus:
    """A mission's setup and progress."""
    visits = mission.records.visits
    return MissionStatus(
        mission_id=mission.mission_id,
        scenario=mission.scenario,
        mode=mission.mode,
        top_k=mission.top_k,
        attention=mission.spec.attention,
        features=mission.features,
        belief=mission.belief_source,
        planner="off" if mission.planner is None else "on",
        verify=mission.spec.verify,
        prompt=mission.spec.prompt,
        init=mission.spec.init,
        seed=mission.spec.seed,
        note=mission.guidance.note,
        decisions=mission.decisions,
        feedback=mission.feedback,
        experiences=len(mission.experiences.block),
        learner_updates=mission.learner.updates,
        learner_loss=mission.learner.last_loss,
        visits={int(s): int(visits[s]) for s in np.flatnonzero(visits >= 0)},
        learned=learned_world(mission.belief),
        deadlines=mission.deadlines() or None,
        readings=mission.readings.merged or None,
    )

"""The answer of ``GET /missions/{id}``."""

import numpy as np

from service.mission.mission import Mission
from shared.belief.fleet_belief import FleetBelief
from shared.wire.missions import LearnedWorld, MissionStatus

# The least mean excess loss of a reported sensor, dB.
_REPORTED_DB = 1.0


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
        names=mission.spec.names,
    )


def learned_world(belief: FleetBelief) -> LearnedWorld | None:
    """How the world differs from the scenario's formulas; None if nothing yet shows that it does."""
    channel, dispersion = belief.channel, belief.arrivals.dispersion
    if channel.by_formula and belief.drift.none and dispersion == 1.0:
        return None
    measured = channel.radio_map.measured_db()
    east, north = belief.drift.wind.tolist()
    return LearnedWorld(
        offset_db=channel.radio_map.offset_db,
        deviation_db=channel.radio_map.deviation_db,
        rate_share=channel.share,
        wind=[east, north],
        dispersion=dispersion,
        failed_radios=channel.failures.dead,
        excess_db={sensor: excess for sensor, excess in measured.items() if abs(excess) > _REPORTED_DB},
    )

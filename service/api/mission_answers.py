"""The answer of ``GET /missions/{id}``."""

import gzip
import hashlib
import re
from http import HTTPStatus

import numpy as np
from fastapi import Response

from service.mission.mission import Mission
from shared.belief.fleet_belief import FleetBelief
from shared.wire.missions import LearnedWorld, MissionAttention, MissionStatus, WeightArray

# The least mean excess loss of a reported sensor, dB.
_REPORTED_DB = 1.0
# Fields of the answer that a mission has, and its spec.
_OF_MISSION = ("mission_id", "scenario", "mode", "top_k", "features", "decisions", "feedback")
_OF_SPEC = ("attention", "verify", "prompt", "init", "seed", "names")


def status_of(mission: Mission) -> MissionStatus:
    """A mission's setup and progress."""
    visits = mission.records.visits
    return MissionStatus(
        **{name: getattr(mission, name) for name in _OF_MISSION},
        **{name: getattr(mission.spec, name) for name in _OF_SPEC},
        belief=mission.belief_source,
        planner="off" if mission.planner is None else "on",
        note=mission.guidance.note,
        experiences=len(mission.experiences.block),
        learner_updates=mission.learner.updates,
        learner_loss=mission.learner.last_loss,
        visits={int(s): int(visits[s]) for s in np.flatnonzero(visits >= 0)},
        learned=learned_world(mission.belief),
        deadlines=mission.deadlines() or None,
        readings=mission.readings.merged or None,
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


# gzip in Accept-Encoding, unless its weight is 0.
_GZIP = re.compile(r"gzip(\s*;\s*q\s*=(?!\s*0(\.0*)?$).*)?")


def attention_of(mission: Mission) -> MissionAttention:
    """The attention module's weights, and the number of sensors that the mission keeps."""
    learner = mission.learner
    arrays = [
        # The shortest digits of a float32; those of a float64 are twice as many for the same float32.
        WeightArray(name=name, shape=list(w.shape), values=[float(str(v)) for v in w.ravel()])
        for name, w in learner.weights.attention.items()
    ]
    return MissionAttention(
        mission_id=mission.mission_id,
        features=mission.features,
        belief=mission.belief_source,
        top_k=min(mission.top_k, mission.scenario.sensors) if mission.uses_attention else mission.scenario.sensors,
        updates=learner.updates,
        weights=arrays,
    )


def attention_response(mission: Mission, known_tags: str | None, encodings: str) -> Response:
    """The mission's attention, or 304 if the client already has it.

    The ETag is a hash of the body. A count of updates would not do: after a crash it may recur with other weights.

    Args:
        known_tags: ``If-None-Match``.
        encodings: ``Accept-Encoding``.
    """
    body = attention_of(mission).model_dump_json().encode()
    etag = f'"{hashlib.sha256(body).hexdigest()[:32]}"'
    headers = {"ETag": etag, "Cache-Control": "no-cache", "Vary": "Accept-Encoding"}
    tags = [tag.strip().removeprefix("W/") for tag in (known_tags or "").split(",")]
    if etag in tags or tags == ["*"]:
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
    if any(_GZIP.fullmatch(one.strip()) for one in encodings.lower().split(",")):
        body = gzip.compress(body, 6, mtime=0)
        headers["Content-Encoding"] = "gzip"
    return Response(body, media_type="application/json", headers=headers)

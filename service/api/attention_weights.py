"""A mission's current attention weights, with which its UAVs prune their reports on board."""

import gzip
import hashlib
import re
from http import HTTPStatus

from fastapi import Response

from service.mission.mission import Mission
from shared.wire.missions import MissionAttention, WeightArray

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

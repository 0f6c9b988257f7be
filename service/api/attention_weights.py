"""What a UAV needs to prune its reports on board: the mission's attention, as it is now."""

from __future__ import annotations

import gzip
import hashlib
from http import HTTPStatus

from fastapi import Response

from service.mission.mission import Mission
from shared.missions import MissionAttention, WeightArray


def attention_of(mission: Mission) -> MissionAttention:
    """The attention module's weights, and how many sensors the mission offers."""
    learner = mission.learner
    arrays = [
        # A float32's own digits: a float64 would have twice as many, and make the same float32.
        WeightArray(name=name, shape=list(w.shape), values=[float(str(v)) for v in w.detach().numpy().ravel()])
        for name, w in learner.attention._asdict().items()
    ]
    return MissionAttention(
        mission_id=mission.mission_id,
        features=mission.features,
        belief=mission.belief_source,
        top_k=min(mission.top_k, mission.scenario.sensors) if mission.uses_attention else mission.scenario.sensors,
        updates=learner.updates,
        weights=arrays,
    )


def told(mission: Mission, held: str | None, accepted: str) -> Response:
    """The mission's attention, or 304 where who asks holds it.

    The ETag is of what is told, not of a count: after a crash other lessons may have made as many updates.

    Args:
        held: ``If-None-Match``.
        accepted: ``Accept-Encoding``.
    """
    body = attention_of(mission).model_dump_json().encode()
    etag = f'"{hashlib.sha256(body).hexdigest()[:32]}"'
    headers = {"ETag": etag, "Cache-Control": "no-cache", "Vary": "Accept-Encoding"}
    tags = [tag.strip().removeprefix("W/") for tag in (held or "").split(",")]
    if etag in tags or tags == ["*"]:
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
    if "gzip" in accepted:
        body = gzip.compress(body, 6, mtime=0)
        headers["Content-Encoding"] = "gzip"
    return Response(body, media_type="application/json", headers=headers)

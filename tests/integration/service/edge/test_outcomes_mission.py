"""An outcome on its own, without its mission's ID."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx

Edge = Callable[..., httpx.Client]
Report = Callable[..., dict[str, Any]]


def test_the_mission_of_an_outcome_is_found_by_its_decision(edge: Edge, report: Report) -> None:
    client = edge()
    client.post("/decide", json=report(mission_id="other"))
    answer = client.post("/decide", json=report()).json()
    outcome = {"decision_id": answer["decision_id"], "cost": 0.2}
    assert client.post("/feedback", json=outcome).json()["result"] == "applied"
    assert client.post("/feedback", json=outcome).json()["result"] == "duplicate"
    assert [client.get(f"/missions/{name}").json()["feedback"] for name in ("test", "other")] == [1, 0]

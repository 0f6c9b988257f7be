"""Worlds that the wire accepts and few would fly in: every mode decides in them, and the page can draw them."""

import json
from collections.abc import Callable
from typing import Any

import httpx
import pytest

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]

NOBODY = "http://127.0.0.1:9/v1"
WORLDS = {
    "nothing arrives": {"arrival_rate_min": 0.0, "arrival_rate_max": 0.0},
    "next to nothing arrives": {"arrival_rate_min": 0.0, "arrival_rate_max": 5e-324},
    "nothing gets through": {"noise_dbm_hz": 0.0, "bandwidth_hz": 1e12},
}


@pytest.mark.parametrize("world", list(WORLDS))
@pytest.mark.parametrize("mode", ["guided", "value", "policy"])
def test_an_odd_world_is_flown_in(edge: Edge, report: Report, mode: str, world: str) -> None:
    client = edge(mode=mode, llm_url=NOBODY)
    spec = {"scenario": {"name": "odd", **WORLDS[world]}}
    assert client.put("/missions/test", json=spec).status_code == 200
    for step in range(3):
        answer = client.post("/decide", json=report(step=step))
        assert answer.status_code == 200, answer.text
    with client.stream("GET", "/missions/test/events") as events:
        line = next(line for line in events.iter_lines() if line.startswith("data:"))
    shown = json.loads(line.removeprefix("data:"))
    assert None not in shown["urgency"] and None not in shown["queue"]

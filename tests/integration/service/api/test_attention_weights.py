"""``GET /missions/{id}/attention``: the weights that decide, with an ETag, for whoever may decide."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from shared.wire.missions import MissionAttention
from tests.integration.service.api.test_authentication import bearer, made
from tests.support.stored_missions import running
from tests.support.waiting import until

Body = dict[str, Any]
Report = Callable[..., Body]
Edge = Callable[..., httpx.Client]
PATH = "/missions/test/attention"


def learned(client: httpx.Client, report: Report) -> None:
    """One decision and its outcome, learned from."""
    before = client.get("/missions/test").json()["learner_updates"]
    decision = client.post("/decide", json=report()).json()["decision_id"]
    client.post("/feedback", json={"mission_id": "test", "decision_id": decision, "cost": 0.5}).raise_for_status()
    until(lambda: client.get("/missions/test").json()["learner_updates"] > before)


@pytest.mark.parametrize(("features", "numbers"), [("paper", 5), ("reach", 12)])
def test_the_weights_are_those_that_decide(tmp_path: Path, report: Report, features: str, numbers: int) -> None:
    with running(tmp_path / "m.db") as (client, engine):
        client.put("/missions/test", json={"features": features, "top_k": 3}).raise_for_status()
        learned(client, report)
        answer = client.get(PATH)
        reported = MissionAttention.model_validate_json(answer.content)
        assert (reported.mission_id, reported.features, reported.belief, reported.top_k) == (
            "test",
            features,
            "fleet",
            3,
        )
        assert reported.updates == 1
        kept = engine.missions.loaded[0].learner.weights.attention
        assert [w.name for w in reported.weights] == ["query", "key", "value", "score", "bias"]
        for w in reported.weights:
            assert np.array_equal(np.array(w.values, np.float32).reshape(w.shape), kept[w.name])
        assert reported.weights[0].shape == [32, numbers]


def test_what_is_held_is_not_sent_again(edge: Edge, report: Report) -> None:
    client = edge()
    client.put("/missions/test", json={}).raise_for_status()
    learned(client, report)
    first = client.get(PATH)
    tag = first.headers["ETag"]
    for held in (tag, f"W/{tag}", f'"other", {tag}', "*"):
        same = client.get(PATH, headers={"If-None-Match": held})
        assert (same.status_code, same.content, same.headers["ETag"]) == (304, b"", tag)
    assert client.get(PATH, headers={"If-None-Match": '"other"'}).content == first.content
    learned(client, report)
    later = client.get(PATH, headers={"If-None-Match": tag})
    assert later.status_code == 200 and later.headers["ETag"] != tag and later.content != first.content


def test_it_comes_compressed_where_that_is_accepted(edge: Edge, report: Report) -> None:
    client = edge()
    client.post("/decide", json=report()).raise_for_status()
    packed, plain = client.get(PATH), client.get(PATH, headers={"Accept-Encoding": "identity"})
    assert packed.headers["Content-Encoding"] == "gzip" and "Content-Encoding" not in plain.headers
    assert packed.json() == plain.json() and packed.headers["ETag"] == plain.headers["ETag"]
    assert packed.num_bytes_downloaded < 0.6 * plain.num_bytes_downloaded


def test_without_attention_every_sensor_is_kept(edge: Edge) -> None:
    client = edge()
    client.put("/missions/test", json={"attention": "off", "mode": "policy"}).raise_for_status()
    assert client.get(PATH).json()["top_k"] == 10


def test_a_mission_that_there_is_not(edge: Edge) -> None:
    client = edge()
    assert client.get(PATH).status_code == 404
    assert client.get("/missions/no mission/attention").status_code == 422
    assert client.get("/missions").json()["missions"] == []


def test_a_key_for_decisions_is_needed(edge: Edge, tmp_path: Path) -> None:
    keys = made(tmp_path / "keys.json", admin=("admin",), decide=("decide",))
    client = edge(keys=tmp_path / "keys.json")
    client.put("/missions/test", json={}, headers=bearer(keys["admin"])).raise_for_status()
    client.put("/missions/attention", json={}, headers=bearer(keys["admin"])).raise_for_status()
    assert client.get(PATH).status_code == 401
    assert client.get(PATH, headers=bearer(keys["admin"])).status_code == 403
    assert client.get(PATH, headers=bearer(keys["decide"])).status_code == 200
    # A mission of that name is read with any key, as others are.
    assert client.get("/missions/attention", headers=bearer(keys["admin"])).status_code == 200


@pytest.mark.parametrize(
    ("accepted", "packed"),
    [("gzip", True), ("br, GZIP;q=0.5", True), ("gzip;q=0", False), ("gzip ; q=0.0, *", False), ("x-gzip", False)],
)
def test_it_is_packed_only_for_who_unpacks_it(edge: Edge, accepted: str, packed: bool) -> None:
    client = edge()
    client.put("/missions/test", json={}).raise_for_status()
    answer = client.get(PATH, headers={"Accept-Encoding": accepted})
    assert ("content-encoding" in answer.headers) is packed
    assert MissionAttention.model_validate_json(answer.content).mission_id == "test"


def test_no_more_sensors_are_kept_than_there_are(edge: Edge) -> None:
    client = edge()
    scenario = {"name": "small", "sensors": 4, "uavs": 1}
    client.put("/missions/test", json={"scenario": scenario, "top_k": 9}).raise_for_status()
    assert client.get(PATH).json()["top_k"] == 4

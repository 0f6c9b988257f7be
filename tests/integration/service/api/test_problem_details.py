"""Bodies with more faults than can be told: a few are, and none of what was sent comes back whole."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from starlette.testclient import TestClient

from service.api.problem_details import install
from service.errors import Misdirected

Body = dict[str, Any]
Report = Callable[..., Body]
Edge = Callable[..., httpx.Client]


def fields(answer: httpx.Response) -> list[str]:
    assert answer.status_code == 422
    return [error["field"] for error in answer.json()["errors"]]


_NAMES = {f"{number:x}": 0 for number in range(15_000)}


@pytest.mark.parametrize(
    ("method", "path", "body", "field"),
    [
        ("POST", "/decide", _NAMES, "body"),
        ("POST", "/feedback", _NAMES, "body"),
        ("POST", "/decide", {"step": 0, "uav_id": 0, "position": [0.0, 0.0], "sensors": _NAMES}, "sensors"),
        ("POST", "/decide/batch", {"step": 0, "uavs": [_NAMES]}, "uavs[0]"),
        ("PUT", "/missions/m", {"prompt": _NAMES}, "prompt"),
        ("POST", "/missions/m/guidance", {"guidance": _NAMES}, "guidance"),
        ("POST", "/missions/m/guidance", {"guidance": {"sensors": [{}] * 1000}}, "guidance.sensors[0].sensor_id"),
        ("PUT", "/missions/m", {"scenario": _NAMES}, "scenario"),
        ("PUT", "/missions/m", {"scenario": {"sites": [["a", "b"]] * 10_000}}, "scenario.sites[0][0]"),
        ("PUT", "/missions/m", {"scenario": {"pipeline": [["a", "b"]] * 1000}}, "scenario.pipeline[0][0]"),
        ("PUT", "/missions/m", {"scenario": {"routes": [[["a", "b"]] * 9] * 99}}, "scenario.routes[0][0][0]"),
    ],
)
def test_faults_without_number_are_a_few(edge: Edge, method: str, path: str, body: Body, field: str) -> None:
    client = edge(max_body_bytes=10_000_000)
    client.put("/missions/m", json={})
    reported = fields(client.request(method, path, json=body))
    # Of a scenario there is one more for its being no name, of a point one for each number, of a route its length.
    assert field in reported
    assert len(reported) <= 4


LISTS = "has more than 120000 lists and objects"
MANY = {f"{number:x}": 0 for number in range(160_000)}


@pytest.mark.parametrize(
    ("method", "path", "body"),
    [
        ("POST", "/decide", MANY),
        ("POST", "/feedback", MANY),
        ("POST", "/decide/batch", {"step": 0, "uavs": [MANY]}),
        ("PUT", "/missions/m", {"scenario": MANY}),
        ("POST", "/missions/m/guidance", {"guidance": MANY}),
        ("POST", "/missions/m/readings", {"readings": [{"sensor_id": 0}] * 60_000}),
        ("POST", "/decide", {"sensors": {"id": [[]] * 600_000}}),
        ("PUT", "/missions/m", {"scenario": [{}] * 600_000}),
    ],
)
def test_a_body_of_names_without_number_is_not_even_parsed(
    edge: Edge, monkeypatch: pytest.MonkeyPatch, method: str, path: str, body: Body
) -> None:
    """To parse one takes most of a second, in which no UAV gets a decision."""
    client = edge(max_body_bytes=10_000_000)
    parsed: list[int] = []
    monkeypatch.setattr("starlette.requests.Request.json", lambda request: parsed.append(1))
    monkeypatch.setattr("service.api.routes.DecideRequest.model_validate_json", lambda text: parsed.append(len(text)))
    for separators in ((", ", ": "), (",", ":"), (",", "\n : ")):
        content = json.dumps(body, separators=separators).encode()
        refused = client.request(method, path, content=content, headers={"Content-Type": "application/json"})
        assert (refused.status_code, refused.headers["content-type"]) == (422, "application/problem+json")
        assert refused.json()["errors"][0]["problem"] in ("has more than 20000 names", LISTS)
    assert parsed == []


def test_the_largest_world_has_fewer(edge: Edge) -> None:
    routes = [[[number, number + 1] for number in range(1000)] for _ in range(100)]
    assert edge().put("/missions/m", json={"scenario": {"routes": routes}}).json()["detail"].startswith("scenario")


def test_a_wrong_report_is_validated_once(edge: Edge, report: Report, monkeypatch: pytest.MonkeyPatch) -> None:
    client = edge()
    parsed: list[int] = []
    monkeypatch.setattr("starlette.requests.Request.json", lambda request: parsed.append(1))
    wrong = client.post("/decide", json=report(uav_id="soon", battery=3))
    assert set(fields(wrong)) == {"uav_id", "battery"} and parsed == []


@pytest.mark.parametrize("method", ["GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS", "TRACE", "BREW"])
@pytest.mark.parametrize(
    "path", ["/", "/decide", "/missions", "/missions/m", "/static/main.js", "/static", "/x", "/%00", "/a b"]
)
def test_every_refusal_is_a_problem(edge: Edge, method: str, path: str) -> None:
    answer = edge().request(method, path, content=b"{")
    if answer.status_code >= 400:
        assert answer.headers["content-type"] == "application/problem+json"
    else:
        assert answer.status_code == 200


@pytest.mark.parametrize("wanted", ["bytes=0-3", "bytes=abc", "bytes=9999999-", "lines=1-2", ""])
def test_a_range_is_the_whole(edge: Edge, wanted: str) -> None:
    client = edge()
    whole = client.get("/static/main.js")
    for path in ("/", "/static/main.js", "/healthz", "/openapi.json", "/metrics"):
        assert client.get(path, headers={"Range": wanted}).status_code == 200
    assert client.get("/static/main.js", headers={"Range": wanted}).content == whole.content


def test_a_name_that_is_no_field_is_not_sent_back_whole(edge: Edge, report: Report) -> None:
    answer = edge().post("/decide", json=report(**{"k" * 1_000_000: 0}))
    assert fields(answer) == ["k" * 80]
    assert len(answer.content) < 1000


def test_broken_json_is_told_with_its_line_and_column(edge: Edge) -> None:
    broken = edge().post(
        "/decide", content='{\n  "step": 0,\n  "uav_id" 1}', headers={"Content-Type": "application/json"}
    )
    assert broken.status_code == 422
    assert "is no JSON: Expecting ':' delimiter, line 3, column 12" in broken.json()["detail"]


def test_a_body_without_a_content_type_is_a_415_that_says_which(edge: Edge, report: Report) -> None:
    for headers in ({}, {"Content-Type": "application/x-www-form-urlencoded"}):
        refused = edge().post("/decide", content=json.dumps(report()).encode(), headers=headers)
        assert refused.status_code == 415
        assert "Content-Type: application/json" in refused.json()["detail"]


@pytest.mark.parametrize(
    ("path", "body", "said"),
    [
        ("/missions/m", {"topk": 3}, "there is no such field; did you mean top_k?"),
        ("/missions/m", {"prompt": {"formatt": "csv"}}, "did you mean format?"),
        ("/missions/m", {"deadline_ms": 100}, "there is no such field in this place"),
        ("/missions/m", {"zzzz": 3}, "there is no such field"),
        ("/missions/m", {"note": "a\nb"}, "note: must be one paragraph"),
        ("/missions/m", [], "must be a JSON object"),
        ("/missions/m", {"seed": "one"}, "seed: must be a valid integer"),
        ("/missions/m", {"note": 3}, "note: must be a valid string"),
    ],
)
def test_a_fault_is_told_in_plain_words(edge: Edge, path: str, body: object, said: str) -> None:
    refused = edge().put(path, json=body)
    assert refused.status_code == 422
    assert said in refused.json()["detail"]
    assert not any(words in refused.text for words in ("Value error", "Extra inputs", "valid dictionary"))


def test_a_request_for_another_edges_mission_names_its_address_there_and_when_its_lease_has_ended() -> None:
    app = FastAPI()
    install(app)

    @app.get("/missions/{mission_id}/guidance")
    async def misdirected(mission_id: str) -> None:
        owner = {"owned": "http://owner:8000", "unnamed": None}[mission_id]
        raise Misdirected("mission_id", "another edge owns it", owner, 7.2 if owner else 0.0)

    with TestClient(app, "http://localhost", follow_redirects=False) as client:
        owned = client.get("/missions/owned/guidance?of=now")
        unnamed = client.get("/missions/unnamed/guidance")
    assert (owned.status_code, owned.json()["owner"], owned.headers["Retry-After"]) == (421, "http://owner:8000", "8")
    assert owned.headers["Location"] == "http://owner:8000/missions/owned/guidance?of=now"
    assert (unnamed.status_code, unnamed.headers["Retry-After"], "Location" in unnamed.headers) == (421, "1", False)

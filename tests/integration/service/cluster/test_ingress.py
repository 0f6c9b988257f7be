"""The ingress: whose answer a request gets, and what becomes of it where its owner is away."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import pytest
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from starlette.routing import Route
from starlette.testclient import TestClient

from service.api.problem_details import problem_response
from service.cluster.exchange import DECIDED_AT, Answer, Exchanged, OwnersGone
from service.cluster.ingress import ingress_application
from service.config.settings import Settings
from shared.wire.missions import MissionLine, MissionList
from shared.wire.schemas import Readiness
from tests.support.edge_stub import free_port
from tests.support.running import listening, serving


class Replies:
    """Owners that remember whom they were asked for, and answer alike, or by address where all are asked."""

    def __init__(self, answer: Answer | Exception, by_address: dict[str, Answer] | None = None) -> None:
        self.answer, self.by_address = answer, by_address or {}
        self.missions: list[str | None] = []

    async def ask(self, request: Exchanged, within_s: float) -> Answer:
        self.missions.append(request.mission_id)
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer

    async def ask_all(self, request: Exchanged, within_s: float) -> dict[str, Answer]:
        if not self.by_address:
            raise OwnersGone("none")
        return self.by_address

    async def address(self, mission_id: str | None, within_s: float) -> str:
        self.missions.append(mission_id)
        return self.answer.body.decode() if isinstance(self.answer, Answer) else ""


def listed(decided_at: float, newest: str | None, more: int = 0, **modes: str | None) -> Answer:
    """An edge's list of missions."""
    lines = [MissionLine(mission_id=name, mode=mode) for name, mode in modes.items()]  # type: ignore[arg-type]
    body = MissionList(missions=lines, more=more, newest=newest, may_command=True).model_dump_json().encode()
    return Answer(200, [(DECIDED_AT.encode(), repr(decided_at).encode())], body)


@contextmanager
def ingress(owners: Replies) -> Iterator[TestClient]:
    ended: list[bool] = []
    app = ingress_application(Settings(store="none"), owners, lambda: ended.append(True))
    with TestClient(app, "http://localhost", raise_server_exceptions=False) as client:
        yield client
    assert ended == [True]


@pytest.mark.parametrize(
    ("method", "path", "body", "mission"),
    [
        ("POST", "/decide", {"mission_id": "m", "step": 0}, "m"),
        ("POST", "/decide", {"step": 0}, "default"),
        ("POST", "/decide/batch", {"mission_id": "m"}, "m"),
        ("POST", "/feedback", {"mission_id": "m"}, "m"),
        ("POST", "/decide", [1], "default"),
        ("POST", "/decide", {"mission_id": 7}, None),
        ("PUT", "/missions/m", {"mission_id": "other"}, "m"),
        ("GET", "/missions/m/guidance", None, "m"),
        ("GET", "/openapi.json", None, None),
    ],
)
def test_a_request_goes_to_the_owner_of_its_mission(method: str, path: str, body: Any, mission: str | None) -> None:
    owners = Replies(Answer(207, [(b"x-of", b"owner")], b"answer"))
    with ingress(owners) as client:
        answer = client.request(method, path, json=body)
    assert (answer.status_code, answer.headers["x-of"], answer.content) == (207, "owner", b"answer")
    assert owners.missions == [mission]


def test_the_ingress_lives_without_owners() -> None:
    with ingress(Replies(OwnersGone("none"))) as client:
        assert client.get("/healthz").json() == {"status": "ok"}


def test_without_an_owner_a_request_is_refused_and_may_come_again() -> None:
    with ingress(Replies(OwnersGone("none"))) as client:
        answer = client.post("/decide", json={"step": 0})
    assert answer.status_code == 503 and answer.headers["Retry-After"] == "1"
    assert answer.headers["Content-Type"] == "application/problem+json"


def test_an_owner_that_moved_and_is_gone_is_a_refusal_too() -> None:
    location = f"http://127.0.0.1:{free_port()}/decide".encode()
    with ingress(Replies(Answer(421, [(b"location", location)], b"{}"))) as client:
        answer = client.post("/decide", json={"step": 0})
    assert answer.status_code == 503 and answer.headers["Retry-After"] == "1"


def test_a_body_past_the_limit_reaches_no_owner() -> None:
    owners = Replies(Answer(200, [], b""))
    with ingress(owners) as client:
        large = json.dumps({"step": "x" * 3_000_000})
        assert client.post("/decide", content=large).status_code == 413
    assert owners.missions == []


def test_the_missions_of_all_edges_are_one_list() -> None:
    owners = Replies(OwnersGone(""), {"a": listed(1.0, "x", x="value", s=None), "b": listed(2.0, "y", s=None, y="llm")})
    with ingress(owners) as client:
        answer = client.get("/missions").json()
    assert {line["mission_id"]: line["mode"] for line in answer["missions"]} == {"x": "value", "y": "llm", "s": None}
    assert answer["newest"] == "y" and answer["may_command"] and answer["more"] == 0


def test_a_mission_in_several_lists_is_shown_as_the_edge_that_has_loaded_it_shows_it() -> None:
    owners = Replies(
        OwnersGone(""), {"a": listed(2.0, None, m=None, n="value"), "b": listed(1.0, None, m="llm", n=None)}
    )
    with ingress(owners) as client:
        lines = client.get("/missions").json()["missions"]
    assert {line["mission_id"]: line["mode"] for line in lines} == {"m": "llm", "n": "value"}


def test_the_number_of_missions_left_out_is_that_of_all_edges() -> None:
    full = {f"x{number}": "value" for number in range(150)}, {f"y{number}": "value" for number in range(150)}
    owners = Replies(OwnersGone(""), {"a": listed(1.0, None, 7, **full[0]), "b": listed(2.0, None, 5, **full[1])})
    with ingress(owners) as client:
        answer = client.get("/missions").json()
    assert (len(answer["missions"]), answer["more"]) == (200, 7 + 5 + 100)


def test_the_metrics_of_all_edges_have_their_addresses() -> None:
    texts = {
        name: Answer(200, [(b"content-type", b"text/plain")], f"# HELP up u\n# TYPE up gauge\nup {number}\n".encode())
        for number, name in enumerate(("one:1", "two:2"))
    }
    with ingress(Replies(OwnersGone(""), texts)) as client:
        lines = client.get("/metrics").text.splitlines()
    assert lines == ["# HELP up u", "# TYPE up gauge", 'up{process="one:1"} 0', 'up{process="two:2"} 1']


@pytest.mark.parametrize("path", ["/missions", "/metrics"])
def test_what_all_edges_refuse_is_refused(path: str) -> None:
    with ingress(Replies(OwnersGone(""), {"a": Answer(401, [(b"www-authenticate", b"Bearer")], b"{}")})) as client:
        answer = client.get(path)
    assert answer.status_code == 401 and answer.headers["WWW-Authenticate"] == "Bearer"


def test_the_cluster_is_ready_when_all_edges_are() -> None:
    states = {name: Readiness(ready=name == "a", decides="value", llm="off", detail=name) for name in "ab"}
    answers = {n: Answer(200 if s.ready else 503, [], s.model_dump_json().encode()) for n, s in states.items()}
    with ingress(Replies(OwnersGone(""), answers)) as client:
        answer = client.get("/readyz")
    assert answer.status_code == 503 and answer.json()["detail"] == "b"


def test_a_cluster_whose_edges_do_not_say_whether_they_are_ready_is_not() -> None:
    refused = {"a": problem_response(403, "an unknown host"), "b": problem_response(503, "the edge ends")}
    answers = {n: Answer(r.status_code, list(r.raw_headers), bytes(r.body)) for n, r in refused.items()}
    with ingress(Replies(OwnersGone(""), answers)) as client:
        answer = client.get("/readyz")
    assert answer.status_code == 503 and "no edge says" in answer.json()["detail"]


def test_an_outcome_that_an_edge_has_applied_is_applied_whatever_another_says() -> None:
    answers = {"a": Answer(503, [], b"{}"), "b": Answer(404, [], b"{}"), "c": Answer(200, [], b'{"result": "applied"}')}
    with ingress(Replies(OwnersGone(""), answers)) as client:
        answer = client.post("/feedback", json={"decision_id": "0" * 32, "cost": 0.0})
    assert (answer.status_code, answer.json()) == (200, {"result": "applied"})


def test_the_llm_of_the_cluster_is_ready_when_that_of_each_edge_is() -> None:
    states = {"a": Readiness(ready=True, decides="llm", llm="ready")}
    states["b"] = Readiness(ready=True, decides="policy", llm="loading")
    answers = {name: Answer(200, [], state.model_dump_json().encode()) for name, state in states.items()}
    with ingress(Replies(OwnersGone(""), answers)) as client:
        answer = client.get("/readyz")
    assert (answer.status_code, answer.json()["llm"], answer.json()["decides"]) == (200, "loading", "policy")


def test_an_outcome_without_a_mission_is_for_the_edge_that_knows_its_decision() -> None:
    answers = {"a": Answer(404, [], b"unknown"), "b": Answer(200, [], b"applied"), "c": Answer(404, [], b"unknown")}
    with ingress(Replies(OwnersGone(""), answers)) as client:
        assert client.post("/feedback", json={"decision_id": "d", "cost": 0.5}).content == b"applied"


async def events(request: Request) -> Response:
    """Two events, and what the request asked for."""

    async def lines() -> AsyncIterator[str]:
        for number in range(2):
            yield f"data: {number} {request.headers['x-for']}\n\n"

    return StreamingResponse(lines(), media_type="text/event-stream")


@pytest.mark.parametrize("moved", [False, True])
def test_a_missions_events_come_from_its_owner(moved: bool) -> None:
    path = "/missions/m/events"
    app = Starlette(routes=[Route(path, events)])
    elsewhere = Starlette()
    with serving(app) as url:

        async def misdirected(request: Request) -> Response:
            return Response(status_code=421, headers={"Location": f"{url}{path}"})

        elsewhere.add_route(path, misdirected)
        with serving(elsewhere) as other:
            owners = Replies(Answer(200, [], (other if moved else url).encode()))
            with ingress(owners) as client, client.stream("GET", path, headers={"X-For": "me"}) as stream:
                assert stream.headers["Content-Type"].startswith("text/event-stream")
                assert [line for line in stream.iter_lines() if line] == ["data: 0 me", "data: 1 me"]
    assert owners.missions == ["m"]


@pytest.mark.parametrize("method", ["GET", "POST", "PUT", "DELETE"])
def test_without_keys_the_ingress_answers_to_this_machines_names_only(method: str) -> None:
    with ingress(Replies(Answer(200))) as client:
        for path in ("/decide", "/missions/m", "/healthz"):
            assert client.request(method, path, headers={"Host": "evil.example"}).status_code == 403


def test_a_fault_of_the_ingress_is_a_problem_too() -> None:
    with ingress(Replies(ValueError("x"))) as client:
        failed = client.get("/missions/m")
    assert (failed.status_code, failed.headers["content-type"]) == (500, "application/problem+json")


def test_of_a_remembered_owner_that_goes_every_request_is_answered() -> None:
    with serving(
        Starlette(routes=[Route("/{path:path}", lambda request: Response("{}", 421), methods=["POST"])])
    ) as gone:
        owners = Replies(Answer(421, [(b"location", f"{gone}/decide".encode())], b"{}"))
        with ingress(owners) as client, ThreadPoolExecutor(8) as pool:
            client.post("/decide", json={"step": 0})
            owners.answer = Answer(200, [], b"{}")
            answers = list(pool.map(lambda step: client.post("/decide", json={"step": step}), range(8)))
    assert {answer.status_code for answer in answers} == {200}


def test_a_request_that_a_remembered_owner_may_have_served_is_not_sent_to_another_edge() -> None:
    """It has made the decision, perhaps: only the client knows whether to send the request again."""
    served: list[bytes] = []

    async def owner(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while head := await reader.readuntil(b"\r\n\r\n"):
            served.append(head)
            if len(served) == 2:
                writer.close()
                return
            writer.write(b"HTTP/1.1 200 OK\r\ncontent-length: 2\r\n\r\n{}")
            await reader.readexactly(len(b'{"step":0}'))

    with listening(owner) as url:
        owners = Replies(Answer(421, [(b"location", f"{url}/decide".encode())], b"{}"))
        with ingress(owners) as client:
            answers = [client.post("/decide", json={"step": 0}).status_code for _ in range(2)]
    assert (answers, len(served), owners.missions) == ([200, 503], 2, ["default"])


def test_a_deeply_nested_body_is_for_its_owner_to_refuse() -> None:
    with ingress(Replies(Answer(400, [], b"{}"))) as client:
        assert client.post("/decide", content=b"[" * 5000).status_code == 400

"""Keys that belong to fleets: for a key that is bound to missions there are no others, in any route."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi.routing import APIRoute

from service.api.api_keys import ApiKeys, BadKeys, KeyFile, Scope
from service.api.app import create_app
from service.api.openapi import REQUESTS
from service.commands.keys import main
from service.config.settings import Settings
from tests.integration.service.api.test_authentication import bearer
from tests.support.stored_missions import running
from tests.support.waiting import PATIENCE_S

Edge = Callable[..., httpx.Client]
Report = Callable[..., dict[str, Any]]
SCOPES: tuple[Scope, ...] = ("decide", "admin", "readings")
# By the route: where it names its mission, and the scope that it needs. A new route needs a rule here.
RULES: dict[str, tuple[str, Scope | None]] = {
    "POST /decide": ("body", "decide"),
    "POST /decide/batch": ("body", "decide"),
    "POST /feedback": ("body", "decide"),
    "PUT /missions/{mission_id}": ("path", "admin"),
    "GET /missions/{mission_id}": ("path", None),
    "DELETE /missions/{mission_id}": ("path", "admin"),
    "GET /missions/{mission_id}/attention": ("path", "decide"),
    "GET /missions/{mission_id}/guidance": ("path", None),
    "POST /missions/{mission_id}/guidance": ("path", "admin"),
    "POST /missions/{mission_id}/readings": ("path", "readings"),
    "GET /missions/{mission_id}/decisions/{decision_id}/prompt": ("path", None),
    "GET /missions/{mission_id}/events": ("path", None),
    "GET /missions": ("list", None),
    "GET /metrics": ("none", None),
    "GET /healthz": ("open", None),
    "GET /readyz": ("open", None),
    "GET /": ("open", None),
}
NAMED = [route for route, (named, _) in RULES.items() if named in ("path", "body")]
MINE, FOREIGN, ABSENT = "north-1", "south-1", "south-2"
BINDINGS: dict[str, tuple[str, ...] | None] = {
    "operator": None,
    "prefix": ("north-*",),
    "name": (MINE,),
    "both": ("x", "north-*"),
    "other": ("east-*", "north", "north-1-2", "orth-1*"),
}
KNOWS = ("operator", "prefix", "name", "both")


def routes() -> Iterator[str]:
    for route in create_app(Settings(mode="value")).routes:
        if isinstance(route, APIRoute):
            yield from (f"{method} {route.path}" for method in route.methods or ())


def test_every_route_has_a_rule() -> None:
    documented = {
        f"{method.upper()} {path}"
        for path, methods in create_app(Settings(mode="value")).openapi()["paths"].items()
        for method in methods
    }
    assert documented <= set(RULES)
    assert set(routes()) == set(RULES)


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[tuple[str, frozenset[Scope]], str]]:
    """A file with a key of each binding and each set of scopes."""
    file, path = KeyFile(), tmp_path_factory.mktemp("keys") / "keys.json"
    scopes = [frozenset(one for at, one in enumerate(SCOPES) if number >> at & 1) for number in range(1, 8)]
    shown = {
        (binding, allowed): file.add(f"{binding}-{'-'.join(sorted(allowed))}", allowed, 100_000, missions)
        for binding, missions in BINDINGS.items()
        for allowed in scopes
    }
    file.write(path)
    return path, shown


@contextmanager
def asked(client: httpx.Client, route: str, mission: str, key: str, decision: str) -> Iterator[httpx.Response]:
    """The answer to a valid request of a route about a mission."""
    method, path = route.split()
    body = json.loads(
        json.dumps(next(iter(REQUESTS.get(f"{method.lower()} {path}", {"": {"value": None}}).values()))["value"])
    )
    if path == "/feedback":
        body |= {"decision_id": decision, "cost": 0.1}
    if RULES[route][0] == "body":
        body |= {"mission_id": mission}
    if path.endswith("readings"):
        body = {"readings": [{"sensor_id": 0, "queue": 1.0, "age_s": 1.0}]}
    if path.endswith("guidance") and body:
        body = {"answer": "reject"}
    if method == "PUT":
        body = {}
    url = path.format(mission_id=mission, decision_id=decision)
    with client.stream(method, url, json=body, headers=bearer(key), timeout=PATIENCE_S) as answer:
        if (
            not answer.headers["content-type"].startswith("text/event-stream")
            if "content-type" in answer.headers
            else True
        ):
            answer.read()
        yield answer


def text_of(answer: httpx.Response) -> str:
    """The text of an answer; of a stream that goes on, none."""
    return answer.text if answer.is_stream_consumed else ""


@pytest.fixture
def flown(edge: Edge, keys: Any, report: Report) -> tuple[httpx.Client, dict[str, str]]:
    """An edge with a mission of ours and a foreign one, and a decision of each."""
    path, shown = keys
    operator = bearer(shown["operator", frozenset(SCOPES)])
    client = edge(keys=path)
    decisions = {}
    for mission in (MINE, FOREIGN):
        client.put(f"/missions/{mission}", json={}, headers=operator).raise_for_status()
        decided = client.post("/decide", json=report(mission_id=mission), headers=operator)
        decisions[mission] = decided.raise_for_status().json()["decision_id"]
    return client, decisions


@pytest.mark.parametrize("binding", BINDINGS)
@pytest.mark.parametrize("route", NAMED)
def test_every_route_scope_and_binding(flown: Any, keys: Any, route: str, binding: str) -> None:
    client, decisions = flown
    needed = RULES[route][1]
    for (bound, scopes), key in keys[1].items():
        if bound != binding:
            continue
        with asked(client, route, FOREIGN, key, decisions[FOREIGN]) as answer:
            foreign = answer.status_code, text_of(answer)
        with asked(client, route, ABSENT, key, decisions[FOREIGN]) as answer:
            absent = answer.status_code, text_of(answer)
        if needed is not None and needed not in scopes:
            assert foreign[0] == absent[0] == 403
        elif binding == "operator":
            assert foreign[0] not in (401, 403, 404)
        else:
            # As if it were not there, to the byte.
            assert foreign == (404, absent[1].replace(ABSENT, FOREIGN))
        with asked(client, route, MINE, key, decisions[MINE]) as answer:
            if needed is not None and needed not in scopes:
                assert answer.status_code == 403
            elif binding in KNOWS:
                assert answer.status_code not in (401, 403, 404), answer.text
            else:
                assert answer.status_code == 404
        if route.startswith("DELETE"):
            operator = bearer(keys[1]["operator", frozenset(SCOPES)])
            for mission in (MINE, FOREIGN):
                client.put(f"/missions/{mission}", json={}, headers=operator).raise_for_status()


def test_the_refusal_says_what_the_key_is_bound_to(flown: Any, keys: Any) -> None:
    client, _ = flown
    refused = client.put(f"/missions/{ABSENT}", json={}, headers=bearer(keys[1]["both", frozenset({"admin"})]))
    said = f"there is no mission {ABSENT} for key both-admin, which is bound to x, north-*"
    assert (refused.status_code, said in refused.json()["detail"]) == (404, True)


@pytest.mark.parametrize(
    ("binding", "listed"),
    [("operator", [FOREIGN, MINE]), ("prefix", [MINE]), ("name", [MINE]), ("both", [MINE]), ("other", [])],
)
def test_the_list_has_a_keys_missions_only(flown: Any, keys: Any, binding: str, listed: list[str]) -> None:
    client, _ = flown
    found = client.get("/missions", headers=bearer(keys[1][binding, frozenset({"decide"})])).json()
    assert [line["mission_id"] for line in found["missions"]] == listed
    assert (found["more"], found["newest"]) == (0, listed[0] if listed else None)
    assert (FOREIGN in str(found)) is (FOREIGN in listed)


@pytest.mark.parametrize("path", ["/metrics", "/readyz", "/openapi.json", "/"])
def test_what_names_no_mission_names_no_foreign_one(flown: Any, keys: Any, path: str) -> None:
    client, decisions = flown
    answer = client.get(path, headers=bearer(keys[1]["prefix", frozenset({"decide"})]))
    assert answer.status_code == 200
    assert FOREIGN not in answer.text and decisions[FOREIGN] not in answer.text


def test_an_outcome_without_a_mission_finds_a_keys_own_decisions_only(flown: Any, keys: Any) -> None:
    client, decisions = flown
    key = bearer(keys[1]["prefix", frozenset({"decide"})])
    unknown = client.post("/feedback", json={"decision_id": "0" * 32, "cost": 0.1}, headers=key)
    foreign = client.post("/feedback", json={"decision_id": decisions[FOREIGN], "cost": 0.1}, headers=key)
    assert foreign.status_code == unknown.status_code == 404
    assert foreign.text.replace(decisions[FOREIGN], "0" * 32) == unknown.text
    mine = client.post("/feedback", json={"decision_id": decisions[MINE], "cost": 0.1}, headers=key)
    assert mine.json()["result"] == "applied"


@pytest.mark.parametrize(("binding", "status"), [("prefix", 404), ("operator", 200)])
def test_an_outcome_without_a_mission_finds_the_stored_default_with_a_key_for_it_only(
    keys: Any, tmp_path: Path, report: Report, binding: str, status: int
) -> None:
    path, shown = keys
    with running(tmp_path / "m.db") as (client, _):
        decision = client.post("/decide", json=report(mission_id="default")).json()["decision_id"]
    with running(tmp_path / "m.db", keys=path) as (client, engine):
        key = bearer(shown[binding, frozenset({"decide"})])
        answer = client.post("/feedback", json={"decision_id": decision, "cost": 0.1}, headers=key)
        assert answer.status_code == status
        assert engine.missions.stored == (["default"] if status == 404 else [])


def test_an_outcome_in_a_report_is_of_the_reports_mission(flown: Any, keys: Any, report: Report) -> None:
    client, decisions = flown
    outcome = {"decision_id": decisions[FOREIGN], "cost": 0.1}
    key = bearer(keys[1]["prefix", frozenset({"decide"})])
    assert client.post("/decide", json=report(mission_id=MINE, step=1, outcome=outcome), headers=key).status_code == 404


@pytest.mark.parametrize("name", ["north-1/../south-1", "south%2D1", "%73outh-1", "south-1/", "./south-1", "/south-1"])
def test_no_spelling_of_a_name_passes(flown: Any, keys: Any, name: str) -> None:
    client, _ = flown
    key = bearer(keys[1]["prefix", frozenset({"decide", "admin"})])
    for method in ("GET", "DELETE"):
        assert client.request(method, f"/missions/{name}", headers=key).status_code in (404, 405)
    assert (
        client.get(f"/missions/{FOREIGN}", headers=bearer(keys[1]["operator", frozenset({"admin"})])).status_code == 200
    )


def test_a_stream_ends_when_its_key_is_bound_elsewhere(
    edge: Edge, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.api.api_keys.STALE_S", 0.0)
    monkeypatch.setattr("service.api.live_routes.KEY_CHECK_S", 0.0)
    monkeypatch.setattr("service.live.broadcaster.HEARTBEAT_S", 0.05)
    file, path = KeyFile(), tmp_path / "keys.json"
    key = bearer(file.add("fleet", frozenset({"admin"}), 100_000))
    file.write(path)
    client = edge(keys=path)
    client.put(f"/missions/{MINE}", json={}, headers=key).raise_for_status()
    with client.stream("GET", f"/missions/{MINE}/events", headers=key) as stream:
        lines = stream.iter_lines()
        assert next(lines) == "event: snapshot"
        file.keys = [file.keys[0].model_copy(update={"missions": ("south-*",)})]
        file.write(path)
        # It ends.
        assert all(line != "event: gone" for line in lines)


def test_the_command_binds_a_key(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = ["--file", str(tmp_path / "keys.json")]
    assert main(["add", "fleet", *file, "--missions", "north-*", "patrol"]) == 0
    found = ApiKeys(tmp_path / "keys.json").find(capsys.readouterr().out.strip())
    assert found is not None and found.missions == ("north-*", "patrol")
    assert [found.allows(name) for name in ("north-", "north-9", "patrol", "patrol-1", "nort", "a-north-1")] == [
        *(True, True, True, False, False, False)
    ]
    assert main(["add", "operator", *file]) == 0
    assert main(["list", *file]) == 0
    listed = capsys.readouterr().out
    assert "north-* patrol" in listed and "all" in listed
    # An earlier edge reads the keys that are bound to nothing.
    assert "missions" not in json.loads((tmp_path / "keys.json").read_text())["keys"][1]


@pytest.mark.parametrize("missions", [["*"], ["north *"], ["*-north"], ["a*b"], [""], []])
def test_a_binding_that_binds_nothing_is_refused(
    tmp_path: Path, missions: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "keys.json"
    assert main(["add", "fleet", "--file", str(file), "--missions", *missions]) == 2
    assert "missions" in capsys.readouterr().err and not file.exists()
    key = {"name": "a", "scopes": ["decide"], "per_minute": 1, "sha256": "0" * 64, "missions": missions}
    file.write_text(json.dumps({"keys": [key]}))
    with pytest.raises(BadKeys, match="missions"):
        KeyFile.read(file)

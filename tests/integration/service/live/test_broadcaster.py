"""The mission page's stream and what it shows, over real sockets; the page itself is tried in tests/page."""

from __future__ import annotations

import asyncio
import hashlib
import json
import signal
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import psutil
import pytest
from starlette.types import Message

from service.api.api_keys import editing
from service.api.live_routes import ASSETS, STATIC
from service.live.broadcaster import MAX_LISTENERS
from service.live.recent_decisions import RecentDecisions
from service.mission.events import Settled
from service.prompting.prompt import Prompt
from service.prompting.unpruned_state import UnprunedState
from service.storage.rows import decode, encode, pack
from shared.wire.schemas import DecideResponse, Outcome, Tokens
from tests.support.missions import attended, mission, uav
from tests.support.processes import serving_edge
from tests.support.waiting import PATIENCE_S, Gate, until

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]
Event = tuple[str, Any]


@contextmanager
def watching(client: httpx.Client, mission: str = "test", **headers: str) -> Iterator[Iterator[Event]]:
    """A listener's events, as they come."""
    with client.stream("GET", f"/missions/{mission}/events", headers=headers) as answer:
        assert answer.status_code == 200, answer.read()
        assert answer.headers["content-type"].startswith("text/event-stream")
        assert answer.headers["x-accel-buffering"] == "no"  # Or nginx 1.22 with `gzip_types *` sends nothing.
        yield parsed(answer.iter_lines())


def parsed(lines: Iterator[str]) -> Iterator[Event]:
    name = ""
    for line in lines:
        if line.startswith("event: "):
            name = line.removeprefix("event: ")
        elif line.startswith("data: "):
            yield name, json.loads(line.removeprefix("data: "))


def decided(client: httpx.Client, body: dict[str, Any]) -> str:
    answer = client.post("/decide", json=body)
    assert answer.status_code == 200, answer.text
    name: str = answer.json()["decision_id"]
    return name


def test_a_listener_gets_a_snapshot_and_then_what_changes(edge: Edge, report: Report) -> None:
    client = edge()
    first = decided(client, report())
    with watching(client) as events:
        name, whole = next(events)
        assert name == "snapshot"
        assert [reported["answer"]["decision_id"] for reported in whole["decisions"]] == [first]
        assert whole["decisions"][0]["position"] == [500.0, 450.0]
        assert whole["decisions"][0]["answer"]["latency_ms"].keys() >= {"store", "total"}
        assert whole["places"][0] == [420.0, 380.0]
        assert whole["places"][9] == [None, None]
        assert whole["queue"][:2] == [52.0, 17.0]
        assert len(whole["trajectories"]) == 3
        outcome = {"decision_id": first, "cost": 0.25, "failed": True, "round_trip_ms": 41.5}
        second = decided(client, report(step=1, outcome=outcome))
        reported: list[str] = []
        heard: list[Any] = []
        while not (reported and heard):
            name, update = next(events)
            assert name == "update"
            reported += [one["answer"]["decision_id"] for one in update["decisions"]]
            heard += update["outcomes"]
        assert reported == [second]
        assert heard == [outcome]
        assert (update["step"], update["made"], update["settled"]) == (1, 2, 1)
        flown = update["uavs"]["0"]
        assert (flown["step"], flown["position"], flown["battery"]) == (1, [500.0, 450.0], None)
        client.delete("/missions/test")
        assert next(events) == ("gone", {})
        assert list(events) == []


def test_updates_come_at_most_ten_times_a_second(edge: Edge, report: Report, monkeypatch: pytest.MonkeyPatch) -> None:
    pauses: list[float] = []

    async def pause(seconds: float) -> None:
        pauses.append(seconds)
        await gate.passed()

    gate, client = Gate(), edge()
    monkeypatch.setattr("service.live.broadcaster.asyncio", SimpleNamespace(**{**vars(asyncio), "sleep": pause}))
    decided(client, report())
    with watching(client) as events, gate:
        next(events)
        decided(client, report(step=1))
        assert next(events)[1]["made"] == 2
        # The next one comes after the pause, and tells of all that happened in it.
        for step in range(2, 61):
            decided(client, report(step=step))
        assert len(pauses) == 1 and pauses[0] >= 0.1
        gate.open()
        assert next(events)[1]["made"] == 61


def test_the_missions_are_listed_the_one_that_decided_last_first(edge: Edge, report: Report) -> None:
    client = edge()
    assert client.get("/missions").json() == {
        "missions": [],
        "more": 0,
        "newest": None,
        "may_command": True,
    }
    client.put("/missions/waits", json={"mode": "policy"})
    for named in ("a", "b", "a"):
        decided(client, report(mission_id=named))
    reported = client.get("/missions").json()
    assert reported["newest"] == "a"
    assert [(one["mission_id"], one["mode"], one["decisions"]) for one in reported["missions"]] == [
        ("a", "value", 2),
        ("b", "value", 1),
        ("waits", "policy", 0),
    ]


def test_a_decisions_prompt_is_told_while_it_is_kept(edge: Edge, report: Report) -> None:
    client = edge()
    name = decided(client, report())
    reported = client.get(f"/missions/test/decisions/{name}/prompt").json()
    assert reported["static"].startswith("You schedule data collection")
    assert reported["state"].count("\n") == 6
    assert reported["asked"] is False
    decided(client, report(mission_id="other"))
    for named, decision in (("other", name), ("test", "0" * 32)):
        assert client.get(f"/missions/{named}/decisions/{decision}/prompt").status_code == 404
    client.delete("/missions/test")
    assert client.get(f"/missions/test/decisions/{name}/prompt").status_code == 404


def test_listeners_are_bounded_and_take_no_decisions_place(edge: Edge, report: Report) -> None:
    client = edge(max_requests=1)
    decided(client, report())
    with ExitStack() as stack:
        listeners = [stack.enter_context(watching(client)) for _ in range(MAX_LISTENERS)]
        assert {next(events)[0] for events in listeners} == {"snapshot"}
        refused = client.get("/missions/test/events")
        assert refused.status_code == 503
        assert refused.headers["retry-after"]
        assert "pages listen already" in refused.json()["detail"]
        decided(client, report(step=1))
    # Those who left take no places any more.
    until(lambda: client.get("/missions/none/events").status_code == 404)


def test_nobody_watches_a_mission_that_there_is_not(edge: Edge) -> None:
    client = edge()
    for _ in range(MAX_LISTENERS + 1):
        assert client.get("/missions/none/events").status_code == 404
    assert client.get("/missions/-/events").status_code == 422


@pytest.mark.long
def test_who_stops_reading_holds_little_and_goes_on_from_a_snapshot(report: Report) -> None:
    """Its mission has 2,000 sensors, so that the system's own buffers are soon full."""
    with serving_edge(AICVDS_MODE="value") as (url, process), httpx.Client(base_url=url, timeout=PATIENCE_S) as client:
        client.put("/missions/large", json={"scenario": {"name": "large", "sensors": 2_000, "uavs": 1}})
        body = report(mission_id="large")
        decided(client, body)
        with ExitStack() as stack:
            stalled = [stack.enter_context(closing(silent_listener(url, "large"))) for _ in range(8)]
            reading = stack.enter_context(watching(client, "large"))
            next(reading)
            edge = psutil.Process(process.pid)
            before = edge.memory_info().rss
            for step in range(1, 151):
                decided(client, {**body, "step": step})
                while next(reading)[1]["step"] < step:
                    pass
            grown = edge.memory_info().rss - before
            # Eight times 150 updates of 40 kB would be 48 MB.
            assert grown < 40e6
            names = names_until(stalled[0], step=150)
        assert names[0] == "snapshot"
        # One that reads nothing for longer than an answer's deadline is cut off, and a page then connects again.
        assert "snapshot" in names[1:] or names[-1] == "end"
        assert len(names) < 150


def silent_listener(url: str, mission: str) -> socket.socket:
    host, port = url.removeprefix("http://").split(":")
    listener = socket.socket()
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    listener.connect((host, int(port)))
    listener.sendall(f"GET /missions/{mission}/events HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
    listener.settimeout(PATIENCE_S)
    return listener


def names_until(listener: socket.socket, step: int) -> list[str]:
    """Of the events that a listener finds when it reads on, until one tells of this step, or the stream ends."""
    names = []
    for line in listener.makefile("rb"):
        if not line.endswith(b"\n"):
            # It is cut off in mid-event.
            names.append("end")
            break
        if line.startswith(b"event: "):
            names.append(line.split()[1].decode())
        elif line.startswith(b"data: ") and json.loads(line[6:])["step"] >= step:
            break
    else:
        names.append("end")
    return names


def test_the_edge_stops_while_pages_watch(report: Report) -> None:
    with serving_edge(AICVDS_MODE="value") as (url, process), httpx.Client(base_url=url, timeout=PATIENCE_S) as client:
        decided(client, report())
        with watching(client) as events, closing(silent_listener(url, "test")):
            next(events)
            process.send_signal(signal.SIGTERM)
            assert list(events) == []
            assert process.wait(PATIENCE_S) == 0


def test_the_page_is_open_and_what_it_shows_needs_a_key(
    edge: Edge, report: Report, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A key is looked at again at each event, and one comes soon.
    monkeypatch.setattr("service.live.broadcaster.HEARTBEAT_S", 0.05)
    monkeypatch.setattr("service.api.live_routes.KEY_CHECK_S", 0.0)
    monkeypatch.setattr("service.api.api_keys.STALE_S", 0.0)
    path = tmp_path / "keys.json"
    with editing(path) as known:
        admin = known.add("fleet", frozenset(("decide", "admin")), 6000)
        reader = known.add("reader", frozenset(("decide",)), 6000)
    client = edge(keys=path)
    client.post("/decide", json=report(), headers={"Authorization": f"Bearer {admin}"})
    for path_ in ("/", "/static/main.js", "/static/vendor/uPlot.esm.js"):
        answer = client.get(path_)
        assert answer.status_code == 200
        assert answer.headers["content-security-policy"].startswith("default-src 'self';")
        assert answer.headers["x-content-type-options"] == "nosniff"
    for path_ in ("/missions", "/missions/test/events", f"/missions/test/decisions/{'0' * 32}/prompt"):
        assert client.get(path_).status_code == 401
    with watching(client, Authorization=f"Bearer {reader}") as events:
        assert next(events)[0] == "snapshot"
        with editing(path) as known:
            known.remove("reader")
        # Its key is known no more.
        assert list(events) == []


def test_the_pages_files_are_sent_whole_or_found_unchanged(edge: Edge) -> None:
    client = edge()
    for path, name, kind in (
        ("/", "index.html", "text/html; charset=utf-8"),
        ("/static/page.css", "page.css", "text/css; charset=utf-8"),
        ("/static/vendor/uPlot.esm.js", "vendor/uPlot.esm.js", "text/javascript; charset=utf-8"),
    ):
        whole = client.get(path)
        assert whole.content == (STATIC / name).read_bytes()
        assert (whole.headers["content-type"], whole.headers["cache-control"]) == (kind, "no-cache")
        assert client.get(path, headers={"If-None-Match": whole.headers["etag"]}).status_code == 304
    plain = client.head("/static/page.css", headers={"Accept-Encoding": "identity"})
    assert plain.headers["content-length"] == str((STATIC / "page.css").stat().st_size)


def test_no_file_is_open_while_a_client_takes_it() -> None:
    """A client may take its time, and the process may open few files."""
    opened: list[str] = []

    async def receive() -> Message:
        await asyncio.Event().wait()
        raise AssertionError

    async def send(message: Message) -> None:
        opened.extend(file.path for file in psutil.Process().open_files())

    scope = {"type": "http", "method": "GET", "path": "/vendor/uPlot.esm.js", "headers": []}
    asyncio.run(ASSETS(scope, receive, send))
    assert [path for path in opened if path.startswith(str(STATIC))] == []


def test_the_library_is_what_its_authors_published() -> None:
    vendor = STATIC / "vendor"
    for line in (vendor / "SHA256SUMS").read_text().splitlines():
        expected, name = line.split()
        assert hashlib.sha256((vendor / name).read_bytes()).hexdigest() == expected, name


def test_the_page_names_no_other_host() -> None:
    for path in STATIC.glob("*.*"):
        text = path.read_text().replace("http://www.w3.org/2000/svg", "")
        assert "http://" not in text and "https://" not in text, path.name
        assert "innerHTML" not in text and "insertAdjacentHTML" not in text, path.name


def answer_of(decision_id: str, mission_id: str = "test") -> DecideResponse:
    tokens = Tokens(
        tokenizer="o200k_base",
        static=1,
        experiences=0,
        state=1,
        state_uncompressed=1,
        prompt=2,
        uncompressed=2,
        saved=0,
    )
    return DecideResponse(
        decision_id=decision_id,
        mission_id=mission_id,
        uav_id=0,
        step=0,
        sensor_id=1,
        velocity=7,
        source="value",
        reason="mode_value",
        top_k=[],
        tokens=tokens,
        deadline_ms=3000,
        latency_ms={"total": 1.0},
    )


def prompt_of(state: str) -> Prompt:
    return Prompt("static", "", state, UnprunedState(attended(mission(), uav()).state))


def test_what_is_kept_is_bounded_in_number_and_in_characters() -> None:
    history = RecentDecisions()
    prompt = prompt_of("x" * 20_000)
    for number in range(2000):
        answer = answer_of(f"{number:032x}", f"m{number % 2}")
        history.decided((0.0, 0.0), prompt, answer)
    kept = history.of("m0") + history.of("m1")
    assert len(kept) == 600
    assert kept[-1].answer.decision_id == f"{1999:032x}"
    prompts = [one.prompt for one in kept if one.prompt is not None]
    assert 100 <= len(prompts) <= 200
    assert kept[-1].prompt is not None
    history.forget("m0")
    history.forget("m1")
    assert history.of("m0") == history.of("m1") == []


def test_a_decision_is_shown_with_its_outcome() -> None:
    history = RecentDecisions()
    history.decided((1.0, 2.0), prompt_of(""), answer_of("a" * 32))
    history.outcome_applied(Outcome(decision_id="a" * 32, cost=1.0))
    history.outcome_applied(Outcome(decision_id="b" * 32, cost=1.0))
    assert [(one.order, one.outcome_order) for one in history.of("test")] == [(1, 2)]


def test_a_round_trip_is_in_no_journal_and_old_journals_are_read() -> None:
    bare = Outcome(decision_id="a" * 32, cost=0.5, failed=True)
    reported = bare.model_copy(update={"round_trip_ms": 12.5})
    assert encode(Settled(reported, True)) == encode(Settled(bare, True))
    old = pack([{"decision_id": "a" * 32, "cost": 0.5, "failed": True}, True])
    assert encode(Settled(reported, True))[1] == old
    assert decode("settled", old) == Settled(bare, True)


def test_a_request_without_a_round_trip_is_the_request_that_it_was() -> None:
    """What a key of idempotency is compared by, over an upgrade too."""
    assert json.loads(Outcome(decision_id="a" * 32, cost=0.5).model_dump_json()).keys() == {
        "decision_id",
        "cost",
        "failed",
    }


@pytest.mark.parametrize("wrong", [-1.0, 600_001.0, "12"])
def test_a_round_trip_out_of_bounds_is_refused_by_name(edge: Edge, report: Report, wrong: Any) -> None:
    outcome = {"decision_id": "a" * 32, "cost": 0.5, "round_trip_ms": wrong}
    refused = edge().post("/decide", json=report(outcome=outcome))
    assert refused.status_code == 422
    assert refused.json()["errors"][0]["field"] == "outcome.round_trip_ms"


def test_a_decision_without_candidates_has_a_prompt_in_no_other_words(edge: Edge, report: Report) -> None:
    """Its text is the paper's, although the mission's prompt is the compact one."""
    client = edge(llm_adapter="served")
    client.put("/missions/test", json={"mode": "policy", "prompt": {"format": "compact"}})
    name = decided(client, report())
    reported = client.get(f"/missions/test/decisions/{name}/prompt")
    assert (reported.status_code, reported.json()["in_words"]) == (200, [])

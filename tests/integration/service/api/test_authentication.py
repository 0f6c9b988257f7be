"""Keys: nobody gets in without one, none does what it may not, and none asks too often."""

from __future__ import annotations

import json
import stat
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.api.api_keys import ApiKeys, BadKeys, KeyFile, Scope, editing
from service.api.authentication import KeyAuthentication
from service.commands.keys import main
from shared.client.edge_client import EdgeClient
from shared.client.errors import EdgeRefused
from shared.wire.schemas import DecideRequest
from tests.support.asking import PATHS, ask

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]


def made(path: Path, **scopes: tuple[Scope, ...]) -> dict[str, str]:
    """A file with keys of these scopes, by name; returns the keys themselves."""
    file = KeyFile()
    shown = {name: file.add(name, frozenset(allowed), per_minute=1000) for name, allowed in scopes.items()}
    file.write(path)
    return shown


def bearer(key: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {key}"}


@pytest.mark.parametrize(
    "headers",
    [
        {},
        bearer("aicvds_wrong"),
        {"Authorization": "Basic YTpi"},
        {"Authorization": "Bearer"},
        [("Authorization", "Bearer KEY"), ("Authorization", "Bearer KEY")],
        {"Authorization": b"Bearer \xff\xfe"},
    ],
)
def test_nobody_gets_in_without_a_key(edge: Edge, report: Report, tmp_path: Path, headers: Any) -> None:
    key = made(tmp_path / "keys.json", fleet=("decide", "admin"))["fleet"]
    client = edge(keys=tmp_path / "keys.json")
    if isinstance(headers, list):
        headers = [(name, value.replace("KEY", key)) for name, value in headers]
    for method, path in (("POST", "/decide"), ("PUT", "/missions/m"), ("GET", "/metrics"), ("GET", "/nowhere")):
        answer = client.request(method, path, json=report(), headers=headers)
        assert answer.status_code == 401, path
        assert answer.headers["www-authenticate"] == "Bearer"
        assert answer.headers["content-type"] == "application/problem+json"
        assert key not in answer.text
    assert client.get("/healthz").status_code == client.get("/readyz").status_code == 200


def test_a_key_does_what_its_scopes_say(edge: Edge, report: Report, tmp_path: Path) -> None:
    keys = made(tmp_path / "keys.json", uav=("decide",), operator=("admin",))
    client = edge(keys=tmp_path / "keys.json")
    note = {"note": "Visit sensor 3 every third step."}
    asks: list[tuple[str, str, dict[str, Any]]] = [
        ("PUT", "/missions/test", note),
        ("POST", "/missions/test/guidance", {"answer": "reject"}),
        ("DELETE", "/missions/test", {}),
    ]
    for method, path, body in asks:
        refused = client.request(method, path, json=body, headers=bearer(keys["uav"]))
        assert refused.status_code == 403
        assert "lacks the scope admin" in refused.json()["detail"]
    # Nor does it make a mission by asking about one that there is not.
    for path in PATHS:
        [refused] = ask(client, path, report(), **bearer(keys["uav"]))
        assert refused.status_code == 404 and "scope admin" in refused.json()["detail"]
    assert client.put("/missions/test", json=note, headers=bearer(keys["operator"])).status_code == 200
    for path in PATHS:
        statuses = [ask(client, path, report(), **bearer(keys[name]))[0].status_code for name in ("operator", "uav")]
        assert statuses == [403, 200]
    for key in keys.values():
        assert client.get("/missions/test", headers=bearer(key)).status_code == 200


def test_a_key_that_asks_too_often_is_told_to_wait(edge: Edge, report: Report, tmp_path: Path) -> None:
    file = KeyFile()
    slow = file.add("slow", frozenset({"decide", "admin"}), per_minute=5)
    other = file.add("other", frozenset({"decide"}), per_minute=5)
    file.write(tmp_path / "keys.json")
    client = edge(keys=tmp_path / "keys.json")
    answers = [client.post("/decide", json=report(step=step), headers=bearer(slow)) for step in range(7)]
    assert [answer.status_code for answer in answers] == [200] * 5 + [429] * 2
    assert 1 <= int(answers[-1].headers["retry-after"]) <= 60
    assert client.post("/decide", json=report(), headers=bearer(other)).status_code == 200


def test_neither_a_second_nor_a_wall_clock_that_jumps_gives_more_requests(
    edge: Edge, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, now, behind = KeyFile(), time.time, [0.0]
    key = bearer(file.add("fleet", frozenset({"decide"}), per_minute=3))
    file.write(tmp_path / "keys.json")
    client = edge(keys=tmp_path / "keys.json")
    assert [client.get("/missions", headers=key).status_code for _ in range(4)] == [200, 200, 200, 429]
    monkeypatch.setattr("time.time", lambda: now() + behind[0])
    monkeypatch.setattr("time.time_ns", lambda: int((now() + behind[0]) * 1e9))
    for jump in (3600.0, -3600.0, 61.0, 119.0, 86_400.0):
        behind[0] = jump
        assert client.get("/missions", headers=key).status_code == 429


async def test_a_keys_requests_may_come_at_once_and_then_evenly(tmp_path: Path) -> None:
    async def app(scope: Any, receive: Any, send: Any) -> None:
        await send({"status": 200})

    file, now, statuses = KeyFile(), [1000.0], list[int]()
    header = (b"authorization", b"Bearer " + file.add("fleet", frozenset({"decide"}), per_minute=6).encode())
    file.write(tmp_path / "keys.json")
    guard = KeyAuthentication(app, ApiKeys(tmp_path / "keys.json"), clock=lambda: now[0])

    async def send(message: Any) -> None:
        statuses.extend([message["status"]] if "status" in message else [])

    async def asked(times: int, after_s: float) -> list[int]:
        now[0] += after_s
        statuses.clear()
        for _ in range(times):
            await guard({"type": "http", "method": "GET", "path": "/missions", "headers": [header]}, None, send)  # type: ignore[arg-type]
        return list(statuses)

    assert await asked(8, 0.0) == [200] * 6 + [429] * 2
    assert await asked(2, 9.9) == [429] * 2
    assert await asked(2, 0.1) == [200, 429]
    assert await asked(4, 30.0) == [200] * 3 + [429]
    assert await asked(8, 3600.0) == [200] * 6 + [429] * 2


def test_a_lost_file_of_keys_is_seen(edge: Edge, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.api.api_keys.STALE_S", 0.0)
    path = tmp_path / "keys.json"
    key = bearer(made(path, fleet=("decide",))["fleet"])
    client, content = edge(keys=path), path.read_bytes()

    def seen() -> tuple[int, str | None, bool]:
        ready = client.get("/readyz")
        lost = "aicvds_keys_lost 1.0" in client.get("/metrics", headers=key).text
        return ready.status_code, ready.json()["detail"], lost

    said = "the file of keys cannot be read: the previous keys apply"
    assert seen() == (200, None, False)
    for lost in (None, b"{", b'{"keys": 3}', b"\xff"):
        path.unlink() if lost is None else path.write_bytes(lost)
        assert seen() == (200, said, True)
        path.write_bytes(content)
        assert seen() == (200, None, False)


def test_a_key_whose_rate_is_lowered_begins_anew(edge: Edge, report: Report, tmp_path: Path) -> None:
    file, path = KeyFile(), tmp_path / "keys.json"
    key = file.add("fleet", frozenset({"decide", "admin"}), per_minute=100)
    file.write(path)
    client = edge(keys=path)
    assert [client.post("/decide", json=report(step=step), headers=bearer(key)).status_code for step in range(9)] == [
        200
    ] * 9
    file.keys = [file.keys[0].model_copy(update={"per_minute": 3})]
    file.write(path)
    time.sleep(1.1)
    answers = [client.post("/decide", json=report(step=step), headers=bearer(key)) for step in range(9, 14)]
    assert [answer.status_code for answer in answers] == [200] * 3 + [429] * 2


def test_a_key_taken_back_is_out_and_a_new_one_in_without_a_restart(tmp_path: Path) -> None:
    path, now = tmp_path / "keys.json", [0.0]
    first = made(path, first=("decide",))["first"]
    keys = ApiKeys(path, clock=lambda: now[0])
    assert keys.find(first) is not None
    second = made(path, second=("decide",))["second"]
    now[0] = 2.0
    assert keys.find(first) is None
    found = keys.find(second)
    assert found is not None and found.name == "second"
    # A file that is broken, or gone, locks nobody out who was in.
    for broken in ("{", None):
        path.unlink() if broken is None else path.write_text(broken)
        now[0] += 2.0
        assert keys.find(second) is not None


def test_a_file_that_cannot_be_read_for_a_while_is_read_when_it_can(tmp_path: Path, monkeypatch: Any) -> None:
    """Neither chmod nor chown change what tells that a file is another."""
    path, now = tmp_path / "keys.json", [0.0]
    leaked = made(path, leaked=("decide",))["leaked"]
    keys = ApiKeys(path, clock=lambda: now[0])
    made(path, other=("decide",))
    with monkeypatch.context() as patched:
        patched.setattr(Path, "open", lambda *_: (_ for _ in ()).throw(PermissionError(13, "denied")))
        now[0] = 2.0
        assert keys.find(leaked) is not None
    now[0] = 4.0
    assert keys.find(leaked) is None


def test_a_changed_file_keeps_its_mode(tmp_path: Path) -> None:
    path = tmp_path / "keys.json"
    made(path, fleet=("decide",))
    path.chmod(0o644)
    with editing(path) as known:
        known.add("other", frozenset({"decide"}), 10)
    assert stat.S_IMODE(path.stat().st_mode) == 0o644


def test_two_that_edit_at_a_time_lose_nothing(tmp_path: Path) -> None:
    path = tmp_path / "keys.json"

    def add(number: int) -> None:
        with editing(path) as known:
            known.add(f"key-{number}", frozenset({"decide"}), 10)

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(add, range(40)))
    assert len(KeyFile.read(path).keys) == 40


def test_the_file_holds_no_key_and_is_its_owners_alone(tmp_path: Path) -> None:
    path = tmp_path / "folder" / "keys.json"
    key = made(path, fleet=("decide",))["fleet"]
    assert key not in path.read_text() and key.removeprefix("aicvds_") not in path.read_text()
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert [p.name for p in path.parent.iterdir()] == ["keys.json"]


def test_the_simulator_flies_with_its_key_and_says_when_it_has_none(edge: Edge, report: Report, tmp_path: Path) -> None:
    key = made(tmp_path / "keys.json", fleet=("decide", "admin"))["fleet"]
    url = str(edge(keys=tmp_path / "keys.json").base_url)
    request = DecideRequest.model_validate(report())
    with EdgeClient(url, timeout_s=5, api_key=key) as client:
        assert client.decide(request).response.source == "value"
    with EdgeClient(url, timeout_s=5) as client, pytest.raises(EdgeRefused, match="401"):
        client.decide(request)


def test_answers_carry_careful_headers(edge: Edge, report: Report) -> None:
    client = edge()
    for answer in (client.get("/healthz"), client.post("/decide", json=report()), client.post("/decide", json={})):
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["cache-control"] == "no-store"
        assert answer.headers["x-frame-options"] == "DENY"


def test_the_command_makes_lists_and_removes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = ["--file", str(tmp_path / "keys.json")]
    assert main(["add", "fleet-1", *file, "--scopes", "decide", "admin"]) == 0
    key = capsys.readouterr().out.strip()
    found = ApiKeys(tmp_path / "keys.json").find(key)
    assert found is not None and found.scopes == {"decide", "admin"}
    assert main(["list", *file]) == 0
    listed = capsys.readouterr().out
    assert "fleet-1" in listed and "admin decide" in listed and key not in listed
    assert main(["add", "fleet-1", *file]) == 2
    assert "there is already a key fleet-1" in capsys.readouterr().err
    assert main(["remove", "fleet-1", *file]) == 0
    assert main(["remove", "fleet-1", *file]) == 2
    with pytest.raises(BadKeys, match="has no key"):
        ApiKeys(tmp_path / "keys.json")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["add", "two words"], "name: must be 1 to 64 letters, digits, "),
        (["add", "fleet", "--per-minute", "0"], "per_minute: must be greater than or equal to 1"),
        (["add", "fleet", "--scopes"], "scopes: "),
        (["list"], "No such file"),
    ],
)
def test_bad_use_is_one_clear_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
) -> None:
    assert main([*arguments, "--file", str(tmp_path / "keys.json")]) == 2
    reported = capsys.readouterr().err
    assert said in reported and reported.count("\n") == 1
    assert not (tmp_path / "keys.json").exists()


@pytest.mark.parametrize(
    ("content", "said"),
    [("[]", "the file: "), ('{"keys": [{"name": "a"}]}', "keys.0.scopes: "), ("nonsense", "the file: is no JSON: ")],
)
def test_a_broken_file_is_named_and_never_quoted(tmp_path: Path, content: str, said: str) -> None:
    (tmp_path / "keys.json").write_text(content)
    with pytest.raises(BadKeys) as caught:
        ApiKeys(tmp_path / "keys.json")
    assert f"keys.json: {said}" in str(caught.value)
    assert "nonsense" not in str(caught.value)


def test_keys_of_another_systems_editor_are_read(tmp_path: Path) -> None:
    path = tmp_path / "keys.json"
    key = made(path, fleet=("decide",))["fleet"]
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    assert ApiKeys(path).find(key) is not None


def test_the_guard_stands_before_the_body(edge: Edge, tmp_path: Path) -> None:
    """A stranger's two megabytes are not even read."""
    made(tmp_path / "keys.json", fleet=("decide",))
    client = edge(keys=tmp_path / "keys.json", max_body_bytes=1000)
    answer = client.post("/decide", content=b"x" * 2_000_000)
    assert answer.status_code == 401
    assert json.loads(answer.text)["title"] == "Unauthorized"


@pytest.mark.parametrize("path", ["/", "/healthz", "/readyz", "/static/page.js"])
@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE"])
def test_what_is_open_is_open_for_reading_only(edge: Edge, tmp_path: Path, method: str, path: str) -> None:
    made(tmp_path / "keys.json", fleet=("decide",))
    client = edge(keys=tmp_path / "keys.json")
    assert client.request(method, path, content=b"{}").status_code == 401
    assert client.get("/healthz").status_code == 200

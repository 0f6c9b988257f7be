"""The file of keys while an edge runs: removed keys, a file that is gone for a while, and limits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from service.api import api_keys
from service.api.api_keys import ApiKeys, BadKeys, KeyFile, editing
from service.api.authentication import KeyAuthentication
from service.commands.keys import main


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def written(path: Path, *names: str, per_minute: int = 10) -> list[str]:
    file = KeyFile()
    shown = [file.add(name, frozenset({"decide"}), per_minute) for name in names]
    file.write(path)
    return shown


def test_once_the_last_key_is_removed_no_key_is_known(tmp_path: Path) -> None:
    path, clock = tmp_path / "keys.json", Clock()
    [key] = written(path, "fleet")
    keys = ApiKeys(path, clock)
    with editing(path) as known:
        known.remove("fleet")
    clock.now = 1.0
    assert keys.find(key) is None
    assert not keys.lost


def test_a_file_that_is_back_unchanged_is_no_longer_lost(tmp_path: Path) -> None:
    """As on a mount that was gone: neither the time nor the size of the file has changed."""
    path, clock = tmp_path / "keys.json", Clock()
    [key] = written(path, "fleet")
    keys = ApiKeys(path, clock)
    path.rename(tmp_path / "away")
    clock.now = 1.0
    assert keys.lost and keys.find(key) is not None
    (tmp_path / "away").rename(path)
    clock.now = 2.0
    assert not keys.lost and keys.find(key) is not None


def test_a_file_that_is_replaced_while_it_is_read_is_read_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, clock = tmp_path / "keys.json", Clock()
    written(path, "first")
    keys, read = ApiKeys(path, clock), KeyFile.read
    shown: list[str] = []

    def replaced(file: Path) -> KeyFile:
        found = read(file)
        shown.extend(written(path, "third"))
        return found

    written(path, "second", "second-2")
    with monkeypatch.context() as patched:
        patched.setattr(KeyFile, "read", replaced)
        clock.now = 1.0
        assert not keys.lost
    clock.now = 2.0
    [third] = shown
    assert keys.find(third) is not None


def test_an_edited_link_stays_a_link_to_the_file_that_the_edge_reads(tmp_path: Path) -> None:
    target, link = tmp_path / "secret" / "keys.json", tmp_path / "keys.json"
    written(target, "fleet")
    link.symlink_to(target)
    with editing(link) as known:
        known.add("other", frozenset({"decide"}), 10)
    assert link.is_symlink()
    assert [key.name for key in KeyFile.read(target).keys] == ["fleet", "other"]


def test_a_file_has_no_more_keys_than_an_edge_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(api_keys, "MOST_KEYS", 2)
    file = KeyFile()
    for name in ("first", "second"):
        file.add(name, frozenset({"decide"}), 10)
    with pytest.raises(BadKeys, match="already 2 keys"):
        file.add("third", frozenset({"decide"}), 10)


def test_a_key_may_only_decide_unless_more_is_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "keys.json"
    assert main(["add", "fleet", "--file", str(path)]) == 0
    [key] = KeyFile.read(path).keys
    assert (set(key.scopes), key.per_minute, key.missions) == ({"decide"}, 6000, None)


async def test_a_request_after_the_named_wait_is_answered_and_one_a_second_earlier_is_not(tmp_path: Path) -> None:
    async def app(scope: Any, receive: Any, send: Any) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": []})

    path, clock = tmp_path / "keys.json", Clock()
    [key] = written(path, "fleet", per_minute=7)
    guard = KeyAuthentication(app, ApiKeys(path, clock), clock)
    answers: list[dict[str, Any]] = []

    async def send(message: Any) -> None:
        if message["type"] == "http.response.start":
            answers.append(message)

    async def asked() -> tuple[int, dict[bytes, bytes]]:
        headers = [(b"authorization", f"Bearer {key}".encode())]
        await guard({"type": "http", "method": "GET", "path": "/missions", "headers": headers}, None, send)  # type: ignore[arg-type]
        return answers[-1]["status"], dict(answers[-1]["headers"])

    assert [(await asked())[0] for _ in range(7)] == [200] * 7
    status, headers = await asked()
    # A seventh of a minute is 8.57 s.
    assert (status, headers[b"retry-after"]) == (429, b"9")
    clock.now = 8.0
    assert (await asked())[0] == 429
    clock.now = 9.0
    assert (await asked())[0] == 200

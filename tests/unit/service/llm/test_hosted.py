"""The embedded LLM that one process has for several, without its llama.cpp."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest

from service.config.process_member import Member
from service.config.settings import Settings
from service.llm.embedded import EmbeddedServer, LoadFailed
from service.llm.hosted import host, hosted

OFF = {"lora": [{"id": 0, "scale": 0.0}]}
READ_AGAIN = {"cache_prompt": False}
ORDERS = {"lora": [{"id": 0, "scale": 0.0}, {"id": 1, "scale": 1.0}], "cache_prompt": False}
SAID = {
    "base_url": "http://127.0.0.1:1/v1",
    "api_key": "k",
    "model": "m+a",
    "bare_model": "m",
    "notes_model": "m+o",
    "without_adapter": OFF,
    "with_orders": ORDERS,
}


async def _each(folder: Path, said: dict[str, Any]) -> list[EmbeddedServer]:
    (folder / "llm.json").write_text(json.dumps(said))
    return [await hosted(Member(slot, 2, folder), Settings()) for slot in range(2)]


def _fields(server: EmbeddedServer, system: str) -> dict[str, Any]:
    with server.request(system, "trained") as sent:
        return sent


async def test_a_prompt_is_read_again_after_any_processs_bare_request(tmp_path: Path) -> None:
    one, two = await _each(tmp_path, SAID)
    assert [_fields(server, "trained") for server in (one, two)] == [{}, {}]
    assert _fields(two, "another") == OFF
    assert [_fields(one, "trained") for _ in range(2)] == [READ_AGAIN, {}]
    # The other process does not know that the first one's prompt was read again.
    assert [_fields(two, "trained") for _ in range(2)] == [READ_AGAIN, {}]
    # While a bare request is under way, the adapter's may be served before it.
    with one.request("another", "trained"):
        assert _fields(two, "trained") == READ_AGAIN
    assert [_fields(two, "trained") for _ in range(2)] == [READ_AGAIN, {}]
    # So it is after a note's.
    with one.note_request() as sent:
        assert sent == ORDERS
        assert _fields(two, "trained") == READ_AGAIN
    assert [_fields(two, "trained") for _ in range(2)] == [READ_AGAIN, {}]
    assert (one.base_url, one.api_key, one.model, one.bare_model) == ("http://127.0.0.1:1/v1", "k", "m+a", "m")
    for server in (one, two):
        server.close()


async def test_a_process_waits_until_the_llm_is_loaded(tmp_path: Path) -> None:
    waiting = asyncio.create_task(hosted(Member(0, 2, tmp_path), Settings()))
    await asyncio.sleep(0.15)
    assert not waiting.done()
    server = (await _each(tmp_path, SAID))[0]
    assert (await waiting).api_key == "k"
    assert not server.gone
    (tmp_path / "llm.json").write_text(json.dumps({**SAID, "api_key": "another"}))
    assert server.gone
    (tmp_path / "llm.json").unlink()
    assert server.gone


async def test_every_process_is_told_why_there_is_none(tmp_path: Path) -> None:
    assert host(Settings(llm_gguf=tmp_path / "none.gguf"), tmp_path) == 2
    with pytest.raises(LoadFailed, match="none.gguf is not there"):
        await hosted(Member(1, 2, tmp_path), Settings())

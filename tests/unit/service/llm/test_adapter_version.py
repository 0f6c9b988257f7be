"""The check that an adapter was trained on the prompt that this edge writes."""

from __future__ import annotations

import asyncio
import json
import struct
from pathlib import Path
from typing import Any, cast

import pytest

from service.config.settings import SHIPPED_ADAPTER, Settings
from service.llm.adapter_version import DECISIONS, ORDERS, PROMPT_VERSION, AdapterUnusable, Version, check_adapter
from service.llm.answers import Completion
from service.llm.client import LLMClient
from service.llm.embedded import EmbeddedServer
from service.llm.model_file import GGUF_NAME, GGUF_SHA256, sha256
from service.llm.request_bodies import Rewriting
from service.llm.server import LlmServer, ServerStatus
from service.mission.prompt_fit import warm_up
from service.prompting.compact_prompt import CompactTemplate
from service.prompting.paper_prompt import Template
from shared.world.scenario import SCENARIOS
from tests.support.waiting import soon


def metadata(version: int, kind: int = 4, key: str = DECISIONS.key) -> bytes:
    return b"GGUF" + bytes(20) + key.encode() + struct.pack("<II", kind, version) + bytes(64)


@pytest.mark.parametrize("version", [DECISIONS, ORDERS])
def test_an_adapter_of_this_version_passes(version: Version, tmp_path: Path) -> None:
    file = tmp_path / "adapter.gguf"
    file.write_bytes(metadata(version.number, key=version.key))
    check_adapter(file, version)


def test_an_adapter_of_the_other_task_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "adapter.gguf"
    file.write_bytes(metadata(PROMPT_VERSION))
    with pytest.raises(AdapterUnusable, match="no adapter of python -m lab distill-orders: set AICVDS_LLM_ORDERS=off"):
        check_adapter(file, ORDERS)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (metadata(PROMPT_VERSION + 1), f"version {PROMPT_VERSION + 1} of the prompt, and this edge writes"),
        (metadata(PROMPT_VERSION, kind=5), "of the prompt"),
        (metadata(PROMPT_VERSION)[:60][: 24 + len(DECISIONS.key) + 3], "no adapter of python -m lab distill"),
        (b"GGUF" + bytes(100), "no adapter of python -m lab distill"),
        (metadata(PROMPT_VERSION)[1:], "no adapter of python -m lab distill"),
        (b"", "no adapter of python -m lab distill"),
    ],
)
def test_any_other_file_is_refused_with_the_remedy(tmp_path: Path, content: bytes, said: str) -> None:
    file = tmp_path / "adapter.gguf"
    file.write_bytes(content)
    with pytest.raises(AdapterUnusable, match=said) as refused:
        check_adapter(file, DECISIONS)
    assert "AICVDS_LLM_ADAPTER=off" in str(refused.value)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(AdapterUnusable, match="cannot be read"):
        check_adapter(tmp_path / "adapter.gguf", DECISIONS)


OFF = {"lora": [{"id": 0, "scale": 0.0}]}
READ_AGAIN = {"cache_prompt": False}


def embedded_server() -> EmbeddedServer:
    """An embedded server with an adapter, without its llama.cpp."""
    server = EmbeddedServer.__new__(EmbeddedServer)
    server.without_adapter, server._bare_requests, server._read_again_after = OFF, 0, 0
    server.with_orders, server.notes_model = {}, "bare"
    return server


def test_a_note_is_read_with_the_orders_adapter_alone_and_decisions_are_read_again_after_it() -> None:
    server = embedded_server()
    server.with_orders = {"lora": [{"id": 0, "scale": 0.0}, {"id": 1, "scale": 1.0}], "cache_prompt": False}
    with server.note_request() as sent:
        assert sent == server.with_orders
    for expected in (READ_AGAIN, {}):
        with server.request("trained", "trained") as sent:
            assert sent == expected


@pytest.mark.parametrize("note", [None, "visit sensor 2 every third step"])
def test_the_adapter_answers_only_the_prompt_that_it_was_trained_on(note: str | None, tmp_path: Path) -> None:
    server = embedded_server()
    trained = warm_up(Settings(mode="llm", llm_adapter=str(tmp_path / "adapter.gguf"))).static

    def fields(system: str) -> dict[str, Any]:
        with server.request(system, trained) as sent:
            return sent

    paper = SCENARIOS["paper"]
    compact = CompactTemplate(paper, rows=5).static
    assert fields(compact) == {}
    assert fields(Template(paper, experiences=8, note=note).static) == OFF
    assert fields("Rewrite the note.") == OFF
    assert [fields(compact) for _ in range(2)] == [READ_AGAIN, {}]


def test_a_prompt_is_read_again_until_one_is_answered_that_was_sent_after_the_bare_request() -> None:
    server = embedded_server()
    with server.request("trained", "trained") as sent:
        assert sent == {}
        with server.request("another", "trained"):
            pass
    with pytest.raises(TimeoutError), server.request("trained", "trained") as sent:
        assert sent == READ_AGAIN
        raise TimeoutError
    for expected in (READ_AGAIN, {}):
        with server.request("trained", "trained") as sent:
            assert sent == expected


async def test_a_rewriting_that_begins_again_counts_as_another_bare_request(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.llm.server.SILENCE_S", 0.0)
    settings = Settings(mode="llm", llm_adapter=str(tmp_path / "adapter.gguf"))
    warm = warm_up(settings)
    sent: list[dict[str, Any]] = []

    class Client:
        async def complete(self, body: dict[str, Any], session: str | None = None) -> Completion:
            sent.append({key: body.get(key) for key in ("lora", "cache_prompt")})
            if len(sent) == 1:
                await asyncio.Event().wait()
            return Completion("visit 0", None, None, None)

    server = LlmServer(settings, warm)
    connection = server.connection
    connection._embedded, connection.client = embedded_server(), cast(LLMClient, Client())
    server.status = ServerStatus("ready")
    rewriting = Rewriting("Rewrite the note.", [], "note", lambda _: {})
    note = asyncio.create_task(server.rewrite(rewriting, temperature=0.0, seed=0))
    await soon(lambda: sent)
    await server.ask("mission", warm.static, "user", [0], 15)
    await note
    await server.ask("mission", warm.static, "user", [0], 15)
    bare, again = {"lora": OFF["lora"], "cache_prompt": None}, {"lora": None, "cache_prompt": False}
    assert sent == [bare, again, bare, again]


def test_the_adapter_that_ships_is_the_one_of_its_card() -> None:
    check_adapter(SHIPPED_ADAPTER, DECISIONS)
    assert SHIPPED_ADAPTER.stat().st_size <= 12_000_000
    card = json.loads(SHIPPED_ADAPTER.with_suffix(".json").read_text(encoding="utf-8"))
    assert (card["adapter_sha256"], card["prompt_version"]) == (sha256(SHIPPED_ADAPTER), PROMPT_VERSION)
    assert (card["base"], card["base_sha256"]) == (GGUF_NAME, GGUF_SHA256)
    assert Settings().embedded_adapter == SHIPPED_ADAPTER

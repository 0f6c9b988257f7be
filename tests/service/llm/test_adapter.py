"""The check that an adapter was trained on the prompt that this edge writes."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import pytest

from service.config.settings import SHIPPED_ADAPTER, Settings
from service.llm.adapter import PROMPT_VERSION, VERSION_KEY, AdapterUnusable, check_adapter
from service.llm.embedded import EmbeddedServer
from service.llm.model_file import GGUF_NAME, GGUF_SHA256, sha256
from service.llm.server import LlmServer
from service.prompting.compact_prompt import CompactTemplate
from service.prompting.prompt import Template
from service.prompting.warm_up import warm_up
from shared.scenario import SCENARIOS


def metadata(version: int, kind: int = 4) -> bytes:
    return b"GGUF" + bytes(20) + VERSION_KEY.encode() + struct.pack("<II", kind, version) + bytes(64)


def test_an_adapter_of_this_version_passes(tmp_path: Path) -> None:
    file = tmp_path / "adapter.gguf"
    file.write_bytes(metadata(PROMPT_VERSION))
    check_adapter(file)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (metadata(PROMPT_VERSION + 1), f"version {PROMPT_VERSION + 1} of the prompt, and this edge writes"),
        (metadata(PROMPT_VERSION, kind=5), "of the prompt"),
        (metadata(PROMPT_VERSION)[:60][: 24 + len(VERSION_KEY) + 3], "no adapter of aicvds distill"),
        (b"GGUF" + bytes(100), "no adapter of aicvds distill"),
        (metadata(PROMPT_VERSION)[1:], "no adapter of aicvds distill"),
        (b"", "no adapter of aicvds distill"),
    ],
)
def test_any_other_file_is_refused_with_the_remedy(tmp_path: Path, content: bytes, said: str) -> None:
    file = tmp_path / "adapter.gguf"
    file.write_bytes(content)
    with pytest.raises(AdapterUnusable, match=said) as refused:
        check_adapter(file)
    assert "AICVDS_LLM_ADAPTER=off" in str(refused.value)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(AdapterUnusable, match="cannot be read"):
        check_adapter(tmp_path / "adapter.gguf")


@pytest.mark.parametrize("note", [None, "visit sensor 2 every third step"])
def test_the_adapter_answers_only_the_prompt_that_it_was_trained_on(note: str | None, tmp_path: Path) -> None:
    settings = Settings(mode="llm", llm_adapter=str(tmp_path / "adapter.gguf"))
    server = LlmServer(settings, warm_up(settings))
    embedded = EmbeddedServer.__new__(EmbeddedServer)
    off = {"lora": [{"id": 0, "scale": 0.0}]}
    embedded.without_adapter, embedded._read_bare = off, False
    server._embedded = embedded
    paper = SCENARIOS["paper"]
    compact = CompactTemplate(paper, rows=5, note=note).static
    assert server._bare(compact) == {}
    assert server._bare(Template(paper, experiences=8, note=note).static) == off
    assert server._bare("Rewrite the note.") == off
    assert [server._bare(compact) for _ in range(2)] == [{"cache_prompt": False}, {}]


def test_the_adapter_that_ships_is_the_one_of_its_card() -> None:
    check_adapter(SHIPPED_ADAPTER)
    assert SHIPPED_ADAPTER.stat().st_size <= 12_000_000
    card = json.loads(SHIPPED_ADAPTER.with_suffix(".json").read_text(encoding="utf-8"))
    assert (card["adapter_sha256"], card["prompt_version"]) == (sha256(SHIPPED_ADAPTER), PROMPT_VERSION)
    assert (card["base"], card["base_sha256"]) == (GGUF_NAME, GGUF_SHA256)
    assert Settings().embedded_adapter == SHIPPED_ADAPTER

"""`aicvds doctor`: each finding, and what to type about it."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.responses import JSONResponse, Response

from service.commands import banner, doctor
from service.config.settings import Settings
from service.llm.answers import Completion
from service.llm.probing import Abilities, Examination
from service.llm.request_bodies import WarmUp
from service.storage.locks import FileLock
from tests.support.running import serving
from tests.support.stub_llm import StubLlm, chat_completion


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


def test_nothing_is_in_the_way(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setenv("AICVDS_MODE", "value")
    monkeypatch.setenv("AICVDS_STORE", str(tmp_path / "new" / "missions.db"))
    assert doctor.main(["--port", str(free_port())]) == 0
    printed = capsys.readouterr().out
    assert "!!" not in printed and "Next:  aicvds serve" in printed
    assert not (tmp_path / "new").exists()


def test_a_taken_port_and_bad_settings_have_remedies(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("AICVDS_TOPK", "3")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        taken.setblocking(False)
        monkeypatch.setenv("AICVDS_PORT", str(taken.getsockname()[1]))
        assert doctor.main([]) == 1
    monkeypatch.setenv("AICVDS_TOP_K", "0")
    assert doctor.main([]) == 1
    printed = capsys.readouterr().out
    assert "aicvds serve --port 0" in printed
    assert "did you mean AICVDS_TOP_K?" in printed and "unset AICVDS_TOPK" in printed
    assert "AICVDS_TOP_K: must be greater" in printed and printed.count("2 in the way") == 2


def test_keys_that_serve_refuses_are_in_the_way(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("AICVDS_MODE", "value")
    faults = [one.found for one in doctor.findings({"host": "0.0.0.0", "port": 0}) if one.what == "keys"]
    assert len(faults) == 1 and "anyone who reaches 0.0.0.0 could control this fleet" in faults[0]
    monkeypatch.setenv("AICVDS_KEYS", str(tmp_path / "none.json"))
    faults = [one.found for one in doctor.findings({"port": 0}) if one.what == "keys"]
    assert len(faults) == 1 and "none.json" in faults[0]


def test_a_missing_adapter_is_in_the_way(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    model = tmp_path / "model.gguf"
    model.touch()
    found, *_ = doctor.embedded(Settings(llm_gguf=model, llm_adapter=str(tmp_path / "none.gguf")))
    assert "none.gguf is not there" in found.found and found.remedy is not None and "AICVDS_LLM_ADAPTER" in found.remedy


def test_a_locked_store_names_its_file(tmp_path: Path) -> None:
    file = tmp_path / "missions.db"
    file.touch()
    settings = Settings(store=str(file))
    assert doctor.store_of(settings).remedy is None
    held = FileLock(str(file))
    try:
        found = doctor.store_of(settings)
        assert "another edge uses" in found.found and found.remedy is not None and "--store" in found.remedy
    finally:
        held.close()


class Thinking(StubLlm):
    """Has one model, refuses ``max_tokens``, thinks for 200 tokens, and answers by a label or two integers."""

    async def respond(self, body: dict[str, Any], probed: bool) -> Response:
        if body.get("model") != "stub-1":
            return JSONResponse({"error": {"message": f"no model {body.get('model')}"}}, 404)
        if "max_tokens" in body:
            return JSONResponse({"error": {"message": "unsupported", "param": "max_tokens"}}, 400)
        if body["max_completion_tokens"] < 200:
            return chat_completion("<think>Hm", finish_reason="length")
        return chat_completion(f"<think>Hm</think>{self.answer}", {"prompt_tokens": 500, "completion_tokens": 201})


def test_an_llm_server_is_asked_as_the_edge_asks_it() -> None:
    with serving(Thinking("A").app) as url:
        named, able, timed = doctor.llm_servers(Settings(llm_url=f"{url}/v1"))
        late = [*doctor.llm_servers(Settings(llm_url=f"{url}/v1", deadline_ms=10))][-1]
        [other] = doctor.llm_servers(Settings(llm_url=f"{url}/v1", llm_model="none-such"))
        [useless] = doctor.llm_servers(Settings(llm_url=f"{url}/v1", mode="llm"))
    [gone] = doctor.llm_servers(Settings(llm_url="http://127.0.0.1:1/v1"))
    assert {named.remedy, able.remedy} == {None}
    assert "stub-1" in named.found
    assert "no token probabilities" in able.found
    assert "max_completion_tokens, 256 tokens of thought" in able.found
    assert "prompt 500 tokens, answer 201" in timed.found
    assert "of the deadline's 0.01 s" in late.found
    assert other.remedy is not None and "no model none-such" in other.found
    assert useless.remedy is not None and "another form" in useless.remedy and "'A'" in useless.found
    assert gone.remedy is not None


def test_an_llm_that_cannot_be_loaded_is_in_the_way(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    fault = "libgomp.so.1: cannot open shared object file"
    (tmp_path / "xllamacpp.py").write_text(f"raise ImportError({fault!r})\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert doctor.main(["--port", str(free_port())]) == 1
    printed = capsys.readouterr().out
    assert "llama.cpp (xllamacpp) cannot be loaded" in printed and "apt-get install libgomp1" in printed


def test_a_missing_model_file_is_fetched(tmp_path: Path) -> None:
    [found] = doctor.embedded(Settings(cache_dir=tmp_path))
    assert found.remedy == "aicvds model fetch"


@pytest.mark.parametrize("address", ["{0}/m.db", "sqlite:///{0}/m.db"])
def test_a_file_is_a_file_by_its_path_or_its_address(tmp_path: Path, address: str) -> None:
    settings = Settings(store=address.format(tmp_path), llm_url=None)
    assert doctor.store_of(settings).found == f"{tmp_path}/m.db (new)"
    assert banner.store(settings, 2) == f"{tmp_path}/m.db, 2 missions"


@pytest.mark.parametrize("address", ["postgresql://u:secret@h/d", "postgresql+psycopg://u:secret@h/d"])
def test_postgresql_is_named_without_its_password(address: str) -> None:
    settings = Settings(store=address)
    assert doctor.store_of(settings).found == "PostgreSQL (not tried)"
    assert banner.store(settings, 1) == "PostgreSQL, 1 mission"


def test_an_address_that_is_none_is_said() -> None:
    assert doctor.store_of(Settings(store="mysql://u:secret@h/d")).remedy == "aicvds serve --store FILE"


@pytest.mark.parametrize(
    "listed",
    [b'{"data": null}', b"[]", b'"text"', b'{"data": [null, 7, {"id": null}, {}]}', b"\xff\xfe", b"[" * 100_000, b"{}"],
)
def test_a_server_needs_no_list_of_models(listed: bytes) -> None:
    app = FastAPI()
    app.get("/v1/models")(lambda: Response(listed, media_type="application/json"))
    app.post("/v1/chat/completions")(StubLlm("A").complete)
    with serving(app) as url:
        found = [*doctor.llm_servers(Settings(llm_url=f"{url}/v1"))]
    assert len(found) == 3 and found[0].remedy is None and "the default model" in found[0].found


@pytest.mark.parametrize("named", ["socks5://127.0.0.1:1", "gopher://x", "http://x:port", "::::"])
def test_no_proxy_ends_in_a_traceback(monkeypatch: pytest.MonkeyPatch, named: str) -> None:
    monkeypatch.setenv("ALL_PROXY", named)
    [found] = doctor.llm_servers(Settings(llm_url="http://llm.example/v1"))
    assert found.remedy is not None and ("proxy" in found.found or "port" in found.found)


def test_keys_without_a_key_and_a_missing_adapter_for_notes_are_in_the_way(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "keys.json").write_text('{"keys": []}')
    monkeypatch.setenv("AICVDS_MODE", "value")
    monkeypatch.setenv("AICVDS_KEYS", str(tmp_path / "keys.json"))
    assert len([one for one in doctor.findings({"port": 0}) if one.what == "keys"]) == 1
    model = tmp_path / "model.gguf"
    model.touch()
    found, *_ = doctor.embedded(Settings(llm_gguf=model, llm_adapter="off", llm_orders=str(tmp_path / "none.gguf")))
    assert "none.gguf is not there" in found.found and "AICVDS_LLM_ORDERS" in (found.remedy or "")


def test_a_home_that_is_not_there_is_no_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/nonexistent/home")
    assert "MB of disk free" in doctor.planner(Settings(store="none")).found


@pytest.mark.parametrize(("deadline_ms", "late"), [(4999, True), (5000, False)])
def test_an_llm_that_misses_the_deadline_is_in_the_way(
    monkeypatch: pytest.MonkeyPatch, deadline_ms: int, late: bool
) -> None:
    async def examined(settings: Settings, warm_up: WarmUp) -> Examination:
        return Examination(Abilities("model"), "", Completion("A", 100, 40, 4), 5.0)

    monkeypatch.setattr("service.llm.probing.examine", examined)
    *_, last = doctor.llm_servers(Settings(llm_url="http://llm.example/v1", deadline_ms=deadline_ms))
    assert ("AICVDS_DEADLINE_MS" in (last.remedy or "")) == late
    # Of the prompt's tokens 40 were cached.
    assert last.found.endswith("prompt 100 tokens (40 cached), answer 4, 13 a second")

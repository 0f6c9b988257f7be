"""The edges of an experiment: their environment, and the identity of their LLM in a flight's key."""

from __future__ import annotations

from pathlib import Path

import httpx
import pytest
from rich.console import Console

from lab.experiments.edges import Llm, _sha256, edge_for, environment_for
from lab.experiments.schemes import ADAPTED, CHANCE, CHANCE_AS_ADAPTED, NAMED_BY_OPTION, OFF, WORST, Backing

SERVER = "http://127.0.0.1:8080/v1"


@pytest.fixture(autouse=True)
def exported(monkeypatch: pytest.MonkeyPatch) -> None:
    """Settings that a user may have exported for other purposes."""
    for name, setting in {
        "AICVDS_TOP_K": "1",
        "AICVDS_EXPERIENCES": "0",
        "AICVDS_LLM_URL": "http://elsewhere/v1",
        "AICVDS_LLM_GGUF": "/another.gguf",
        "AICVDS_LLM_MODEL": "big",
        "AICVDS_LLM_API_KEY": "secret",
        "AICVDS_LLM_THREADS": "2",
    }.items():
        monkeypatch.setenv(name, setting)


def settings(backing: str, llm: Llm) -> dict[str, str]:
    with environment_for(backing, llm) as environment:
        own = {"AICVDS_MAX_MISSIONS", "AICVDS_LOG_LEVEL", "AICVDS_STORE", "AICVDS_VERIFY"}
        if environment["AICVDS_LLM_ADAPTER"] == "off":
            own.add("AICVDS_LLM_ADAPTER")
        return {k: v for k, v in environment.items() if k.startswith("AICVDS_") and k not in own}


def test_only_settings_that_cannot_change_a_decision_are_inherited() -> None:
    assert settings(NAMED_BY_OPTION, Llm()) == {"AICVDS_LLM_THREADS": "2"}
    assert settings(OFF, Llm()) == {"AICVDS_LLM_THREADS": "2", "AICVDS_MODE": "value"}


def test_a_server_gets_its_model_and_key() -> None:
    named = settings(NAMED_BY_OPTION, Llm(SERVER))
    assert named.pop("AICVDS_LLM_THREADS")
    assert named == {"AICVDS_LLM_URL": SERVER, "AICVDS_LLM_MODEL": "big", "AICVDS_LLM_API_KEY": "secret"}


def test_a_model_file_is_embedded_by_its_whole_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert settings("m.gguf", Llm())["AICVDS_LLM_GGUF"] == str(tmp_path / "m.gguf")


def test_only_the_scheme_that_names_the_adapter_has_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    adapter = tmp_path / "adapter.gguf"
    monkeypatch.setenv("AICVDS_LLM_ADAPTER", str(adapter))
    for backing in (NAMED_BY_OPTION, OFF, CHANCE):
        assert "AICVDS_LLM_ADAPTER" not in settings(backing, Llm())
    assert not Llm().flies(ADAPTED)
    adapter.write_bytes(b"one")
    assert Llm().flies(ADAPTED) and not Llm("none").flies(ADAPTED)
    assert settings(ADAPTED, Llm())["AICVDS_LLM_ADAPTER"] == str(adapter)
    first = Llm().identity(ADAPTED)
    adapter.write_bytes(b"two")
    _sha256.cache_clear()
    assert Llm().identity(ADAPTED) != first


def test_draws_at_random_come_from_a_server_of_our_own() -> None:
    with environment_for(CHANCE, Llm()) as environment:
        assert httpx.get(f"{environment['AICVDS_LLM_URL']}/models").status_code == 200
    with pytest.raises(httpx.ConnectError):
        httpx.get(f"{environment['AICVDS_LLM_URL']}/models")


def test_llms_that_may_answer_differently_have_different_identities(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "m.gguf").write_bytes(b"one")
    (tmp_path / "m.gguf").write_bytes(b"two")
    files = [Llm().identity(str(path)) for path in (tmp_path / "m.gguf", tmp_path / "a" / "m.gguf")]
    named = [llm.identity(NAMED_BY_OPTION) for llm in (Llm(), Llm(SERVER), Llm(edge="http://e:8000"))]
    assert named[0].startswith("embedded ") and named[1].startswith(f"{SERVER} big ")
    # All edges begin with the same weights of their modules.
    assert len({name.rpartition(" ")[2] for name in (*files, *named, Llm().identity(OFF))}) == 1
    assert len({*files, *named, Llm().identity(OFF), Llm().identity(CHANCE)}) == 7


def test_whether_there_is_an_llm_to_ask() -> None:
    assert Llm().available and Llm(SERVER).available and not Llm("none").available
    assert Llm("none", edge="http://e:8000").available


@pytest.mark.long
@pytest.mark.parametrize("backing", [CHANCE, CHANCE_AS_ADAPTED, WORST])
def test_an_edge_takes_a_stand_in_for_an_llm(backing: Backing, tmp_path: Path) -> None:
    with edge_for(backing, Llm(), tmp_path / "edge.log", Console(quiet=True)) as edge:
        assert edge.model

from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from service.config.settings import Settings
from shared.kit.cores import usable_cores


@pytest.mark.parametrize(("quota", "cores"), [("100000 100000", 1), ("50000 100000", 1), ("99900000 100000", None)])
def test_a_containers_quota_counts(tmp_path: Path, quota: str, cores: int | None) -> None:
    (tmp_path / "cpu.max").write_text(f"{quota}\n")
    assert usable_cores(tmp_path / "cpu.max") == (cores or usable_cores(tmp_path / "none"))


def test_no_quota_is_no_limit(tmp_path: Path) -> None:
    (tmp_path / "cpu.max").write_text("max 100000\n")
    assert usable_cores(tmp_path / "cpu.max") == usable_cores(tmp_path / "none") >= 1


@pytest.mark.parametrize(
    "url",
    [
        *("localhost:8080", "ftp://host/v1", "http:/host", "http:///v1", "http://[::1/v1", "http://me:PASS@host/v1"),
        "http://ho\tst/v1",
    ],
)
def test_an_llm_url_must_be_one(url: str) -> None:
    with pytest.raises(ValidationError, match="llm_url") as caught:
        Settings(llm_url=url)
    assert all("PASS" not in fault["msg"] for fault in caught.value.errors())


def test_a_trailing_slash_makes_no_difference() -> None:
    assert Settings(llm_url="http://host/v1/").llm_url == "http://host/v1"


def test_a_key_read_from_a_file_loses_its_newline_and_never_shows() -> None:
    settings = Settings(llm_api_key="sk-secret\n")
    assert settings.llm_api_key is not None
    assert settings.llm_api_key.get_secret_value() == "sk-secret"
    assert "secret" not in repr(settings)
    with pytest.raises(ValidationError, match="printable ASCII"):
        Settings(llm_api_key="sk-\u00e9")


def test_experiences_that_cannot_fit_the_context_are_refused() -> None:
    with pytest.raises(ValidationError, match="AICVDS_LLM_CONTEXT"):
        Settings(llm_adapter="off", experiences=100, top_k=60)
    assert Settings(llm_adapter="off", experiences=100, top_k=60, llm_context=16_384).experiences == 100
    # More than a mission's own setting may have, so that no client could read the mission's status.
    with pytest.raises(ValidationError, match="experiences"):
        Settings(llm_adapter="off", experiences=101, llm_context=16_384)


@pytest.mark.parametrize("given", [{"mode": "policy", "top_k": 67}, {"mode": "value", "top_k": 100}, {"top_k": 80}])
def test_only_a_prompt_that_is_written_must_fit_the_context(given: dict[str, Any]) -> None:
    assert Settings(**given).top_k == given["top_k"]
    with pytest.raises(ValidationError, match="AICVDS_LLM_CONTEXT"):
        Settings(**given | {"mode": "llm", "llm_adapter": "off"})


@pytest.mark.parametrize("text", ["[1]", "no JSON", '{"a": ', "7"])
def test_further_fields_are_a_json_object(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setenv("AICVDS_LLM_EXTRA_BODY", text)
    with pytest.raises(ValidationError, match="must be a JSON object"):
        Settings()
    monkeypatch.setenv("AICVDS_LLM_EXTRA_BODY", '{"reasoning_effort": "none", "n": {"m": [1]}}')
    assert Settings().llm_extra_body == {"reasoning_effort": "none", "n": {"m": [1]}}


@pytest.mark.parametrize("headers", [{"a": "b\r\nc: d"}, {"a\n": "b"}, {"a": "ü"}])
def test_further_headers_are_printable(headers: dict[str, str]) -> None:
    with pytest.raises(ValidationError, match="printable ASCII"):
        Settings(llm_extra_headers=headers)


@pytest.mark.parametrize(
    ("name", "least", "most"),
    [
        ("deadline_ms", 10, 60_000),
        ("planner_ms", 10, 60_000),
        ("hedge_ms", 0, 60_000),
        ("lease_s", 1.0, 300.0),
        ("llm_load_s", 1.0, 3600.0),
        ("llm_slots", 0, 10_000),
        ("llm_concurrency", 1, 10_000),
        ("llm_thinking_tokens", 0, 131_072),
        ("max_requests", 1, 100_000),
        ("max_body_bytes", 1_000, 1_000_000_000),
        ("max_missions", 1, 1_000_000),
        ("port", 0, 65_535),
    ],
)
def test_a_number_out_of_its_bounds_is_refused(name: str, least: Any, most: Any) -> None:
    for value in (least, most):
        assert getattr(Settings(**{name: value}), name) == value
    for value in (least - 1, most + 1):
        with pytest.raises(ValidationError, match=name):
            Settings(**{name: value})


def test_an_empty_variable_is_an_unset_one(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("LLM_URL", "LLM_MODEL", "PORT", "KEYS", "EXPERIENCES"):
        monkeypatch.setenv(f"AICVDS_{name}", "")
    settings = Settings()
    assert (settings.llm_url, settings.llm_model, settings.port) == (None, None, 8000)
    assert (settings.keys, settings.experiences) == (None, None)


def test_no_secret_shows() -> None:
    settings = Settings(
        llm_extra_headers={"api-key": "private-1"},
        llm_extra_query={"code": "private-2"},
        store="postgresql://me:private-3@host/missions",
    )
    assert "private" not in repr(settings) + str(settings)

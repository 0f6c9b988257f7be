"""Fixtures shared by the simulator's tests."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import pytest

from tests.support.undrawn import reports_undrawn


@pytest.fixture
def undrawn() -> Iterator[None]:
    """Flights of this test draw no report."""
    with reports_undrawn():
        yield


@pytest.fixture
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """The planner searches in one run, for tests that do not cover the quality of its plans."""
    monkeypatch.setattr("shared.planning.receding.RUNS", [(0, 0.05)])


@pytest.fixture(autouse=True)
def unbounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Flights search no bound on their losses, which takes longer than most of them."""
    monkeypatch.setattr("simulator.bound.clairvoyant_bound.mission_bound", lambda *_: "a test leaves it out")


@pytest.fixture
def without_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulate an installation without torch and TorchRL."""
    for module in [name for name in sys.modules if name.startswith(("lab.marl", "torchrl."))]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.setitem(sys.modules, "torchrl", None)

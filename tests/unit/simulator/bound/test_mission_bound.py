"""The bound that a report has: searched after the flight, for a limited time."""

from __future__ import annotations

import pytest

from shared.world.scenario import SCENARIOS, Scenario

# By name: the fixture that spares the other tests its search replaces the module's function.
from simulator.bound.clairvoyant_bound import mission_bound
from simulator.flying.flight import baselines
from simulator.records.summary import LossBound
from simulator.sites.site import Site

SHORT = Site(Scenario(steps=8))


def test_no_baseline_loses_less() -> None:
    bound = mission_bound(SHORT, 0, 8, 20.0)
    assert isinstance(bound, LossBound)
    assert bound.lower_bound <= bound.best_flight
    for tally in baselines(SHORT, 0, 8).values():
        assert bound.lower_bound <= sum(step.lost_packets for step in tally)


def test_why_there_is_none_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    assert mission_bound(SHORT, 0, 7, 20.0) == "the mission ended before its last step"
    assert "too large" in str(mission_bound(Site(SCENARIOS["dense"]), 0, 30, 20.0))

    def without_ortools(*_: object) -> None:
        raise ModuleNotFoundError("No module named 'ortools'", name="ortools")

    monkeypatch.setattr("simulator.bound.clairvoyant_bound.clairvoyant", without_ortools)
    assert "aic-vds[bound]" in str(mission_bound(SHORT, 0, 8, 20.0))

"""The words and numbers of a mission's report."""

from __future__ import annotations

import pytest

from shared.scenario import Scenario
from simulator.flying.flight import Flight, fly
from simulator.flying.pilots import LocalPilot
from simulator.records.summary import Summary, summarise
from simulator.reporting.wording import number, verdict
from simulator.sites.site import Site

SHORT = Scenario(steps=5)


def summary_of(flight: Flight, model: str | None) -> Summary:
    facts = flight.facts(
        policy="edge", edge="http://edge:8000", mission_id="paper-0-1", mode="llm", model=model,
        deadline_ms=None, command="aicvds simulate",
    )  # fmt: skip
    return summarise(facts, flight.decisions, {"aic_vds": flight.tally})


@pytest.fixture(scope="module")
def flight() -> Flight:
    """A flight in which every second decision has the fields of an edge's decision."""
    flown = fly(Site(SHORT), LocalPilot("eof", SHORT, 0), seed=0)
    flown.decisions = [
        d.model_copy(update={"rtt_ms": 10.0 + n, "source": "llm", "attempts": 1, "request_bytes": 900}) if n % 2 else d
        for n, d in enumerate(flown.decisions)
    ]
    return flown


def test_the_verdict_ranks(flight: Flight) -> None:
    summary = summary_of(flight, None)
    for lost, rank in ((1, "the fewest"), (2, "as many as the best"), (3, "neither"), (4, "neither"), (5, "the most")):
        sentence = verdict(summary.model_copy(update={"lost_packets": {"aic_vds": lost, "eof": 2, "wqcs": 4}}))
        assert rank in sentence and sentence.count(".") == 1
    assert "the same" in verdict(summary.model_copy(update={"lost_packets": {"eof": 2, "wqcs": 2}}))
    assert "Nothing was flown" in verdict(summary.model_copy(update={"steps_flown": 0}))


def test_numbers_have_separators_and_a_dash_for_none() -> None:
    assert [number(None), number(1234.56), number(0.5, 3)] == ["–", "1,234.6", "0.500"]

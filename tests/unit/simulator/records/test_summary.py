"""A mission's summary from its decisions: late ones, and the share of the prompt from the LLM server's cache."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest

from shared.wire.schemas import Tokens
from simulator.records.summary import FlightFacts, is_late, summarise
from tests.unit.simulator.records.test_statistics import decision

FACTS = FlightFacts(
    scenario="paper", seed=0, steps=1, steps_flown=1, uavs=3, sensors=2, policy="edge", edge="http://edge",
    mission_id="m", mode="llm", model=None, deadline_ms=500, interrupted=False,
    started_at=datetime(2026, 1, 2, tzinfo=UTC), duration_s=1.0, version="0", command="",
)  # fmt: skip


def tokens(cached: int | None, server_prompt: int | None) -> Tokens:
    counts = ("static", "experiences", "state", "state_uncompressed", "prompt", "uncompressed", "saved")
    return Tokens(tokenizer="t", **dict.fromkeys(counts, 10), cached=cached, server_prompt=server_prompt)


@pytest.mark.parametrize(
    ("rtt_ms", "deadline_ms", "late"), [(550.0, 500, False), (550.1, 500, True), (None, 500, False), (9e9, None, False)]
)
def test_a_decision_is_late_after_its_deadline_and_fifty_milliseconds(
    rtt_ms: float | None, deadline_ms: int | None, late: bool
) -> None:
    one = decision(rtt_ms=rtt_ms, deadline_ms=deadline_ms)
    assert is_late(one) == late and summarise(FACTS, [one], {}).late == late


def test_the_cached_share_is_of_the_decisions_whose_server_says_how_much_it_had() -> None:
    counts = [(80, 100), (0, 300), (None, 1000), (50, None)]
    decisions = [decision(rtt_ms=1.0, tokens=tokens(*count)) for count in counts]
    found = summarise(FACTS, decisions, {}).tokens
    assert found.cached_pct == pytest.approx(100 * 80 / 400)
    assert found.cached_mean == pytest.approx(130 / 3)

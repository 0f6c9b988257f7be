"""The measures of a flight, compared with values computed by hand."""

from __future__ import annotations

import pytest

from lab.experiments.flight import TokenCounts
from lab.experiments.measures import MEASURES, STEP_MEASURES, ages, substituted_decisions
from tests.support.tiny_flights import decided, flown


def test_losses_are_counted_per_step_and_cumulative() -> None:
    flight = flown(failures=[1, 0, 2], overflows=[0, 3, 0], lost_packets=[0, 12, 0])
    assert MEASURES["lost_packets"].of(flight) == 12
    assert MEASURES["events"].of(flight) == 6
    assert STEP_MEASURES["events_per_step"].of(flight) == [1, 3, 2]
    assert STEP_MEASURES["events_cumulative"].of(flight) == [1, 4, 6]
    assert STEP_MEASURES["lost_packets_cumulative"].of(flight) == [0, 12, 12]


def test_age_is_one_after_a_service_and_grows_without() -> None:
    flight = flown([decided(0, 0), decided(1, 1), decided(2, 0), decided(2, 2, failed=True, uav=1)])
    assert ages(flight).tolist() == [[1, 1, 1], [2, 1, 2], [1, 2, 3]]
    assert MEASURES["aoi_mean"].of(flight) == pytest.approx(14 / 9)
    assert MEASURES["aoi_peak"].of(flight) == pytest.approx((2 + 2 + 3) / 3)
    assert MEASURES["aoi_worst"].of(flight) == 3
    assert STEP_MEASURES["aoi_per_step"].of(flight) == pytest.approx([1, 5 / 3, 2])


def test_jain_counts_served_visits_or_scheduled_ones() -> None:
    flight = flown([decided(0, 0), decided(1, 1), decided(2, 2, failed=True)])
    assert MEASURES["jain"].of(flight) == pytest.approx(2 / 3)
    assert MEASURES["jain_scheduled"].of(flight) == pytest.approx(1.0)
    assert MEASURES["jain"].of(flown([decided(0, 0, failed=True)])) is None


def test_tokens_are_means_over_decisions_and_savings_over_totals() -> None:
    counts = [TokenCounts(prompt=90, uncompressed=130, state=10, state_uncompressed=50, cached=5)] * 2
    counts.append(TokenCounts(prompt=120, uncompressed=140, state=40, state_uncompressed=50))
    flight = flown([decided(step, 0, tokens=count) for step, count in enumerate(counts)])
    assert MEASURES["state_tokens"].of(flight) == 20
    assert MEASURES["state_saved_pct"].of(flight) == pytest.approx(60)
    assert MEASURES["prompt_saved_pct"].of(flight) == pytest.approx(25)
    assert MEASURES["cached_tokens"].of(flight) == 5
    assert MEASURES["completion_tokens"].of(flight) is None


def test_round_trips_and_their_shares() -> None:
    stages = {"llm": 60.0, "attend": 10.0, "total": 80.0}
    flight = flown([decided(s, 0, rtt_ms=100.0 * (s + 1), latency_ms=stages) for s in range(3)])
    assert MEASURES["rtt_p50"].of(flight) == 200
    assert MEASURES["share_llm"].of(flight) == pytest.approx(30)
    assert MEASURES["share_network"].of(flight) == pytest.approx(60)
    assert STEP_MEASURES["rtt_ms_per_step"].of(flight) == [100, 200, 300]
    assert MEASURES["rtt_p50"].of(flown([decided(0, 0)])) is None


def test_the_llms_trust_is_that_of_the_last_decisions_with_one() -> None:
    weights: list[dict[str, float]] = [{"llm": 0.2}, {"llm": 0.4}, {"llm": 0.6}, {}, {"planner": 1.0}]
    flight = flown([decided(step, 0, trust=weight) for step, weight in enumerate(weights)])
    last = [weight["llm"] for weight in weights[:3]][-flight.uavs :]
    assert MEASURES["llm_trust"].of(flight) == pytest.approx(sum(last) / len(last))
    assert MEASURES["llm_trust"].of(flown([decided(0, 0)])) is None


def test_substituted_decisions_exclude_those_without_a_candidate() -> None:
    reasons = ["llm_timeout", "answer_sensor", "no_candidate", "edge_unreachable", None]
    flight = flown([decided(0, 0, reason=reason) for reason in reasons])
    assert substituted_decisions(flight) == 3

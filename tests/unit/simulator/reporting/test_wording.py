"""The words and numbers of a mission's report."""

from __future__ import annotations

from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from shared.planning.guidance_messages import OrderRecord
from shared.world.scenario import Scenario
from simulator.flying.flight import fly
from simulator.flying.pilots import LocalPilot
from simulator.records.flight import Flight
from simulator.records.operator import OperatorRecord
from simulator.records.real_uavs import RealUavs, sums_by_uav
from simulator.records.summary import BySource, LossBound, Summary, summarise
from simulator.reporting.comparison import MissionResult, caution
from simulator.reporting.results import show
from simulator.reporting.wording import (
    bound_text,
    deciders_text,
    late_text,
    llm_notice,
    number,
    orders_text,
    percent,
    policy_labels,
    verdict,
    world_text,
)
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


def test_a_policy_of_ones_own_keeps_its_name(flight: Flight) -> None:
    lost = {"longest_queue": 1, "my_rules.py:Own_One": 2, "eof": 3}
    labels = policy_labels(summary_of(flight, None).model_copy(update={"lost_packets": lost}))
    assert [labels[name] for name in lost] == ["longest queue", "my_rules.py:Own_One", "EOF"]


def test_real_uavs_claim_only_what_they_heard(flight: Flight, tmp_path: Path) -> None:
    simulated = summary_of(flight, None)
    assert "real_uavs" not in simulated.model_dump_json() and late_text(simulated) is None
    real = RealUavs(
        uavs=sums_by_uav(flight.decisions, {0: (1610.0, 1316.0)}), late=2, undecided={"it lands": 3},
        not_carried_out=["UAV 1 denied"], simulated_lost=None, ended={1: "it lands"}, warnings=["UAV 2: it waits"],
    )  # fmt: skip
    changes = {
        "real_uavs": real,
        "seed": None,
        "steps_flown": 4,
        "lost_packets": {"aic_vds": 1},
        "loss_events": {"aic_vds": 1},
    }
    summary = Summary.model_validate_json(simulated.model_copy(update=changes).model_dump_json())
    assert summary.real_uavs == real and world_text(summary) == "paper, real sensors"
    assert verdict(summary) == "The UAVs heard that sensors lost 1 packet in this flight."
    assert "these losses cannot be compared" in caution(
        [MissionResult(tmp_path, simulated), MissionResult(tmp_path, summary)]
    )
    console = Console(width=120, file=StringIO())
    show(summary, console)
    assert isinstance(console.file, StringIO)
    shown = console.file.getvalue()
    for text in (
        "4 of 5 steps",
        "lost packets heard of",
        "Late: 2 decisions",
        "3 waypoints without a decision: it lands",
        "UAV 1 did not fly its mission at the end: it lands.",
        "Warning: UAV 0 flew 1,316 m where 1,610 m were decided.",
        "Warning: UAV 2: it waits.",
    ):
        assert text in shown
    assert "1 commands not carried out; the last: UAV 1 denied." in shown and "simulated sensors" not in shown


def test_the_verdict_ranks(flight: Flight) -> None:
    summary = summary_of(flight, None)
    for lost, rank in ((1, "the fewest"), (2, "as many as the best"), (3, "neither"), (4, "neither"), (5, "the most")):
        sentence = verdict(summary.model_copy(update={"lost_packets": {"aic_vds": lost, "eof": 2, "wqcs": 4}}))
        assert rank in sentence and sentence.count(".") == 1
    assert "the same" in verdict(summary.model_copy(update={"lost_packets": {"eof": 2, "wqcs": 2}}))
    assert "Nothing was flown" in verdict(summary.model_copy(update={"steps_flown": 0}))


def test_the_operators_orders_are_named_beside_the_losses(flight: Flight) -> None:
    summary = summary_of(flight, None)
    assert orders_text(summary) is None
    order = {
        "name": "visit:3",
        "in_words": "Visit sensor 3.",
        "note": None,
        "since_step": 0,
        "since": summary.started_at,
    }
    record = OrderRecord.model_validate(order)
    unconfirmed, obeyed = (OperatorRecord(in_force=orders, deadlines=[]) for orders in ([], [record, record]))
    said = orders_text(summary.model_copy(update={"operator": unconfirmed}))
    assert said is not None and said.startswith("No order of the operator was in force")
    said = orders_text(summary.model_copy(update={"operator": obeyed}))
    assert said == "Orders of the operator were in force, which may cost packets: Visit sensor 3."


def guided(**changes: object) -> Summary:
    flown = fly(Site(SHORT), LocalPilot("eof", SHORT, 0), seed=0)
    weights = {"llm": 0.004, "planner": 0.97, "value": 0.026}
    flown.decisions = [d.model_copy(update={"source": "guided", "trust": weights}) for d in flown.decisions]
    flown.decisions[0] = flown.decisions[0].model_copy(update={"source": "policy", "reason": "llm_timeout"})
    return summary_of(flown, "stub-1").model_copy(update={"mode": "guided", **changes})


def test_in_mode_guided_the_planner_has_its_own_share() -> None:
    summary = guided()
    assert summary.trust == pytest.approx({"planner": 0.97, "value": 0.026, "llm": 0.004})
    assert deciders_text(summary) == "14 guided (planner 97%), 1 policy"
    said = llm_notice(summary)
    assert said is not None and "The LLM took" not in said
    assert "The LLM was one of several advisers in 14 of 15 decisions." in said
    assert "planner 97%, learned values 3%, LLM <1%" in said and "llm_timeout 1" in said


def test_the_report_says_what_the_mission_loses_without_the_llm() -> None:
    said = llm_notice(guided(without_llm=1))
    assert said is not None
    assert said.endswith("Without the LLM (mode policy) the same edge lost 1 packet in this world.")


def test_a_mission_without_the_llm_says_so(flight: Flight) -> None:
    none = BySource(policy=15)
    said = llm_notice(guided(by_source=none, trust={}))
    assert said is not None and said.startswith("The LLM took part in none of the 15 decisions: 15 by the edge's")
    assert llm_notice(guided(mode="policy")) is None


def test_the_bound_is_beside_the_loss(flight: Flight) -> None:
    summary = summary_of(flight, None).model_copy(update={"lost_packets": {"aic_vds": 9}})
    assert bound_text(summary) is None
    tight = summary.model_copy(update={"bound": LossBound(lower_bound=1, best_flight=1, seconds=1.0)})
    assert bound_text(tight) == "Nobody can lose fewer than 1 packet in this world; this mission lost 9."
    loose = summary.model_copy(update={"bound": LossBound(lower_bound=1, best_flight=3, seconds=1.0)})
    longer = "A search that knows all arrivals found a flight that loses 3; `aicvds bound` searches longer."
    assert bound_text(loose) == f"{bound_text(tight)} {longer}"


def test_a_share_is_rounded_to_0_or_1_only_if_it_is() -> None:
    assert [percent(share) for share in (0, 0.001, 0.5, 0.999, 1)] == ["0%", "<1%", "50%", ">99%", "100%"]


def test_numbers_have_separators_and_a_dash_for_none() -> None:
    assert [number(None), number(1234.56), number(0.5, 3)] == ["–", "1,234.6", "0.500"]

"""The operator's visit orders: which deadlines a fleet met, by its decisions and their outcomes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from service.api.mission_answers import status_of
from service.mission import visit_orders
from service.mission.visit_orders import VisitOrders
from shared.planning.guidance_messages import GuidanceAnswer
from shared.planning.orders import NO_GUIDANCE, Guidance, SensorWish
from shared.wire.missions import VisitDeadline
from tests.support.missions import mission
from tests.unit.service.mission.test_mission import decide, outcome


def orders(**every: int) -> Guidance:
    """Of sensors by name: ``s3=2`` visits sensor 3 every 2 steps."""
    return Guidance(sensors=[SensorWish(sensor_id=int(name[1:]), visit_every=n) for name, n in every.items()])


def lines(counts: list[VisitDeadline]) -> list[tuple[Any, ...]]:
    return [(one.sensor_id, one.visit_every, one.since, one.until, one.met, one.missed) for one in counts]


def test_deadlines_begin_once_the_whole_time_was_under_the_order() -> None:
    kept, wish = VisitOrders(), orders(s1=3)
    for step in range(5):
        kept.follow(wish, step)
    kept.visit(1, 3)
    assert lines(kept.counts(4)) == [(1, 3, 0, None, 2, 1)]
    assert lines(kept.counts(1)) == [(1, 3, 0, None, 0, 0)]


def test_a_failed_visit_is_none_and_another_in_its_step_stays() -> None:
    kept, wish = VisitOrders(), orders(s1=1)
    kept.follow(wish, 0)
    kept.visit(1, 0)
    kept.visit(1, 0)
    kept.visit(2, 0)
    kept.withdraw(2, 0)
    kept.withdraw(1, 0)
    assert lines(kept.counts(0)) == [(1, 1, 0, None, 1, 0)]
    kept.withdraw(1, 0)
    kept.withdraw(1, 0)
    assert lines(kept.counts(0)) == [(1, 1, 0, None, 0, 1)]


def test_new_orders_end_the_ones_before_at_the_next_step() -> None:
    kept = VisitOrders()
    kept.follow(NO_GUIDANCE, 0)
    kept.follow(orders(s1=1, s2=2), 0)
    kept.follow(orders(s1=1, s2=2), 1)
    kept.follow(orders(s1=1, s2=3), 2)
    kept.follow(NO_GUIDANCE, 4)
    assert lines(kept.counts(5)) == [(2, 2, 1, 2, 0, 0), (1, 1, 1, 4, 0, 3), (2, 3, 2, 4, 0, 0)]
    # An outcome may come after the order's end; what comes after it is not the order's.
    kept.visit(1, 3)
    kept.visit(1, 4)
    assert lines(kept.counts(9))[1] == (1, 1, 1, 4, 1, 2)


def test_a_long_mission_forgets_visits_and_no_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(visit_orders, "FINAL_AFTER", 5)
    rng, wish = np.random.default_rng(0), orders(s0=1, s1=4, s2=12)
    bounded, visited = VisitOrders(), {sensor: set[int]() for sensor in range(3)}
    for step in range(200):
        bounded.follow(wish, step)
        sensor = int(rng.integers(0, 3))
        bounded.visit(sensor, step)
        visited[sensor].add(step)
        if step % 7 == 6:
            bounded.withdraw(sensor, step)
            visited[sensor].discard(step)
    for one in bounded.counts(199):
        ends = range(one.visit_every - 1, 200)
        met = sum(bool(visited[one.sensor_id] & set(range(end - one.visit_every + 1, end + 1))) for end in ends)
        assert (one.met, one.missed) == (met, len(ends) - met)
    assert all(len(order["visits"]) < 30 for order in bounded.state_dict()["orders"])


def test_a_restored_state_is_the_same() -> None:
    kept, again = VisitOrders(), VisitOrders()
    for step, wish in enumerate((orders(s1=1, s2=2), orders(s1=1), orders(s1=1))):
        kept.follow(wish, step)
        kept.visit(1, step)
    again.load_state_dict(kept.state_dict())
    for one in (kept, again):
        one.follow(orders(s1=1), 3)
        one.withdraw(1, 2)
    assert again.state_dict() == kept.state_dict()
    assert lines(again.counts(3)) == [(2, 2, 0, 1, 0, 0), (1, 1, 0, None, 2, 2)]


def test_a_mission_judges_steps_that_are_over() -> None:
    fleet = mission()
    assert status_of(fleet).deadlines is None
    fleet.answer_guidance(GuidanceAnswer(guidance=orders(s4=1)))
    first = decide(fleet, 1, step=0, sensor=4)
    assert lines(fleet.deadlines()) == [(4, 1, 0, None, 0, 0)]
    second = decide(fleet, 2, step=1, sensor=4)
    assert lines(fleet.deadlines()) == [(4, 1, 0, None, 1, 0)]
    fleet.apply(outcome(first, failed=True))
    assert lines(fleet.deadlines()) == [(4, 1, 0, None, 0, 1)]
    fleet.apply(outcome(second))
    assert lines(fleet.deadlines()) == [(4, 1, 0, None, 1, 1)]
    assert status_of(fleet).deadlines == fleet.deadlines()


def test_a_decision_that_another_replaces_is_no_visit() -> None:
    fleet = mission()
    fleet.answer_guidance(GuidanceAnswer(guidance=orders(s4=1)))
    decide(fleet, 1, step=0, sensor=4)
    decide(fleet, 2, step=0, sensor=5)
    decide(fleet, 3, step=1, sensor=4)
    assert lines(fleet.deadlines()) == [(4, 1, 0, None, 0, 1)]

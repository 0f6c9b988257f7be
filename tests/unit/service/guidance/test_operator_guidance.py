"""The ends of orders: when an order ends, which ends are refused, and what of an end is doubted."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from service.errors import Refused
from service.guidance.operator_guidance import OperatorGuidance
from shared.planning.guidance_messages import GuidanceAnswer
from shared.planning.orders import End, Guidance, SensorWish
from tests.support.missions import PAPER

ONCE = Guidance(sensors=[SensorWish(sensor_id=3, visit_every=1)], ends={"visit:3": End(visited=3)})


def slow(velocity: int, **end: object) -> Guidance:
    """A limit of the velocity, with an end."""
    return Guidance(max_velocity=velocity, ends={"max_velocity": End.model_validate(end)} if end else {})


def test_an_order_until_a_visit_ends_with_one_in_its_first_step_and_not_with_an_earlier_one() -> None:
    given, visits = OperatorGuidance(None, PAPER), np.full(PAPER.sensors, -1)
    given.answer(GuidanceAnswer(guidance=ONCE), 5)
    visits[3] = 4
    assert not given.expire(6, 7, visits)
    visits[3] = 5
    assert given.expire(6, 7, visits) and given.orders is None
    assert [(order.since_step, order.until_step) for order in given.report("test").orders] == [(5, 7)]


def test_an_order_ends_before_the_decisions_of_its_last_step() -> None:
    given, visits = OperatorGuidance(None, PAPER), np.full(PAPER.sensors, -1)
    given.answer(GuidanceAnswer(guidance=slow(5, steps=3)), 5)
    assert [given.expire(step, step + 1, visits) for step in (6, 7, 8)] == [False, False, True]


def test_an_end_that_has_passed_is_refused_and_one_to_come_is_not() -> None:
    given, now = OperatorGuidance(None, PAPER), datetime.now(UTC)
    hour = timedelta(hours=1)
    for passed, said in (({"time": now - hour}, "this time has passed"), ({"step": 5}, "at step 5 already")):
        with pytest.raises(Refused, match=said):
            given.answer(GuidanceAnswer(guidance=slow(5, **passed)), 5)
    assert given.orders is None
    for to_come in ({"time": now + hour}, {"step": 6}):
        given.answer(GuidanceAnswer(guidance=slow(5, **to_come)), 5)
        assert not given.expire(5, 6, np.full(PAPER.sensors, -1))


def test_an_order_in_place_of_a_lasting_one_is_doubted_where_it_ends() -> None:
    for end, doubts in (({}, []), ({"step": 9}, ["“Never fly faster than 8 m/s.” ends too, and does not come back."])):
        given = OperatorGuidance(None, PAPER)
        given.answer(GuidanceAnswer(guidance=slow(8)), 0)
        given.answer(GuidanceAnswer(note="slower"), 0)
        given.propose(slow(5, **end), None)
        assert given.report("test").doubts == doubts

"""The deadlines of an operator's orders, counted again from a flight's own decisions."""

from __future__ import annotations

import pytest

from shared.wire.missions import VisitDeadline
from simulator.records.operator import OperatorRecord, recount_deadlines
from tests.unit.simulator.records.test_statistics import decision

# Sensor 4 is visited in step 3; in step 7 the transmission fails.
DECISIONS = [
    decision(step=3, sensor_id=4),
    decision(step=7, sensor_id=4, failed=True),
    decision(step=6, sensor_id=5),
]


@pytest.mark.parametrize(("until", "counted"), [(8, (2, 2)), (10, (2, 4)), (20, (2, 4)), (None, (2, 4))])
def test_deadlines_end_with_their_order_or_the_flight_and_are_met_by_visits_that_succeeded(
    until: int | None, counted: tuple[int, int]
) -> None:
    order = VisitDeadline(sensor_id=4, visit_every=3, since=2, until=until, met=90, missed=90)
    found = recount_deadlines([order], DECISIONS, 10)
    assert found == [order.model_copy(update={"met": counted[0], "missed": counted[1]})]
    both = OperatorRecord(deadlines=found * 2)
    assert (both.met, both.missed) == (2 * counted[0], 2 * counted[1])

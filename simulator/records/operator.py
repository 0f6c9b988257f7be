"""The operator's part of a flight: the orders that were in force, and the visit deadlines met and missed."""

from collections.abc import Iterable, Sequence

from shared.planning.guidance_messages import OrderRecord
from shared.planning.orders import count_deadlines
from shared.wire.missions import VisitDeadline
from simulator.records.decision import Decision, Record


class OperatorRecord(Record):
    """Every order that was in force in a step of the flight, with its note, and every visit order's deadlines."""

    in_force: list[OrderRecord] = []
    deadlines: list[VisitDeadline]

    @property
    def met(self) -> int:
        """The deadlines that were met."""
        return sum(one.met for one in self.deadlines)

    @property
    def missed(self) -> int:
        """The deadlines that were missed."""
        return sum(one.missed for one in self.deadlines)


def recount_deadlines(
    orders: Iterable[VisitDeadline], decisions: Sequence[Decision], steps: int
) -> list[VisitDeadline]:
    """The orders with the deadlines that these decisions met and missed; an edge does not know those taken on board.

    Args:
        orders: the edge's; only their counts are replaced.
        decisions: of the flight.
        steps: that were flown.
    """
    served: dict[int, set[int]] = {}
    for d in decisions:
        if not d.failed:
            served.setdefault(d.sensor_id, set()).add(d.step)
    counted = []
    for order in orders:
        last = steps - 1 if order.until is None else min(steps, order.until) - 1
        met, missed = count_deadlines(order.visit_every, order.since, last, served.get(order.sensor_id, ()))
        counted.append(order.model_copy(update={"met": met, "missed": missed}))
    return counted

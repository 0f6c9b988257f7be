"""The operator's orders to visit sensors, and their deadlines met and missed."""

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from shared.planning.orders import Guidance, count_deadlines, once
from shared.wire.missions import VisitDeadline

# Most ended orders in memory.
_MOST_ENDED = 100
# Steps after which no outcome changes a count: more than a fleet's UAVs may be apart.
FINAL_AFTER = 128


@dataclass(slots=True)
class _Order:
    """One sensor's order, in force from step ``since`` until before ``until``.

    ``met`` and ``missed`` are those of deadlines that are final; the others have their first step at ``open_since`` or
    later, and ``visits`` has the number of visits of each step with any.
    """

    sensor_id: int
    every: int
    since: int
    until: int | None = None
    met: int = 0
    missed: int = 0
    open_since: int = 0
    visits: dict[int, int] = field(default_factory=dict)

    def count(self, through: int) -> tuple[int, int]:
        """Deadlines met and missed up to a step."""
        last = through if self.until is None else min(through, self.until - 1)
        met, missed = count_deadlines(self.every, self.open_since, last, self.visits)
        return self.met + met, self.missed + missed

    def close(self, through: int) -> None:
        """Make the deadlines up to a step final, and forget the visits that no later one needs."""
        self.met, self.missed = self.count(through)
        self.open_since = max(self.open_since, through - self.every + 2)
        self.visits = {step: n for step, n in self.visits.items() if step >= self.open_since}


class VisitOrders:
    """The visit orders of one mission, in force and ended.

    Attributes:
        last: the newest step with a decision; -1 before the first.
    """

    def __init__(self) -> None:
        self.last = -1
        self._final = -1
        self._followed: Guidance | None = None
        self._open: dict[int, _Order] = {}
        self._ended: deque[_Order] = deque(maxlen=_MOST_ENDED)

    def follow(self, guidance: Guidance, step: int) -> None:
        """Follow the orders in force at a decision of a step; call it before :meth:`visit`."""
        if guidance is not self._followed:
            self._followed = guidance
            # A step with an earlier decision counts for the previous orders.
            self._change(guidance, step if step > self.last else self.last + 1)
        self.last = max(self.last, step)
        if self.last - self._final > 2 * FINAL_AFTER:
            self._final = self.last - FINAL_AFTER
            for order in self._orders():
                order.close(self._final)

    def _change(self, guidance: Guidance, since: int) -> None:
        # A single visit has no deadline.
        wanted = {
            int(name[6:]): int(value)
            for name, value in guidance.values.items()
            if name.startswith("visit:") and not once(name, value, guidance.ends.get(name))
        }
        for sensor, order in list(self._open.items()):
            if wanted.get(sensor) != order.every:
                order.until = since
                self._ended.append(self._open.pop(sensor))
        for sensor, interval in wanted.items():
            if sensor not in self._open:
                self._open[sensor] = _Order(sensor, interval, since, open_since=since)

    def visit(self, sensor_id: int, step: int) -> None:
        """Count a visit; :meth:`withdraw` takes it back if it fails."""
        for order in self._of(sensor_id):
            if step >= order.open_since:
                order.visits[step] = order.visits.get(step, 0) + 1

    def withdraw(self, sensor_id: int, step: int) -> None:
        """Take a visit back: it failed, or another decision replaced it."""
        for order in self._of(sensor_id):
            if (visits := order.visits.pop(step, 0)) > 1:
                order.visits[step] = visits - 1

    def counts(self, through: int) -> list[VisitDeadline]:
        """Each order's deadlines up to a step, the ended orders first."""
        counts = []
        for order in self._orders():
            met, missed = order.count(through)
            sensor, every, since, until = order.sensor_id, order.every, order.since, order.until
            counts += [
                VisitDeadline(sensor_id=sensor, visit_every=every, since=since, until=until, met=met, missed=missed)
            ]
        return counts

    def _orders(self) -> Iterator[_Order]:
        yield from self._ended
        yield from self._open.values()

    def _of(self, sensor_id: int) -> Iterator[_Order]:
        yield from (order for order in self._ended if order.sensor_id == sensor_id)
        if (order := self._open.get(sensor_id)) is not None:
            yield order

    def state_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {"last": self.last, "final": self._final, "orders": [asdict(order) for order in self._orders()]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a ``state_dict``."""
        self.last, self._final, self._followed = state["last"], state["final"], None
        orders = [_Order(**{**order, "visits": dict(order["visits"])}) for order in state["orders"]]
        self._open = {order.sensor_id: order for order in orders if order.until is None}
        self._ended = deque((order for order in orders if order.until is not None), maxlen=_MOST_ENDED)

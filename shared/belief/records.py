"""The visiting record and the arrival rate of each sensor, from visits and beacons of a fleet or of one UAV."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared.belief.fleet_belief import NOTHING_MEASURED, FleetBelief, Measured
from shared.wire.schemas import UavState
from shared.wire.sensor_arrays import arrays_of
from shared.world.channel import FloatArray
from shared.world.scenario import Scenario

# The weight, in steps, of the scenario's mean arrival rate against the observations.
_PRIOR_STEPS = 2.0
# Of a UAV whose steps go back further, another flight begins.
_LATE_STEPS = 3
NEVER = -1


class Records:
    """The records of every sensor.

    Attributes:
        visits: TVR_j, shape ``(J,)``: the step of the latest visit that is confirmed, or still open and presumed to
            succeed; -1 for none.
        confirmed: the same, without the visits that are still open.
    """

    def __init__(self, scenario: Scenario) -> None:
        count = scenario.sensors
        self._capacity = scenario.queue_capacity
        self.visits: NDArray[np.int64] = np.full(count, NEVER, dtype=np.int64)
        self.confirmed = np.full(count, NEVER, dtype=np.int64)
        self._open: dict[int, dict[str, int]] = {}
        self._seen = np.full(count, NEVER, dtype=np.int64)
        self._queue = np.zeros(count)
        self._arrivals = np.full(count, scenario.mean_arrival_rate * _PRIOR_STEPS)
        self._exposure = np.full(count, _PRIOR_STEPS)

    @property
    def rates(self) -> FloatArray:
        """Observed arrival rates lambda_hat, packets a step, shape ``(J,)``."""
        rates: FloatArray = self._arrivals / self._exposure
        return rates

    def hear(self, ids: NDArray[np.int64], seen: NDArray[np.int64], queue: FloatArray) -> None:
        """Add the beacons that are newer than the known ones, ``(n,)`` each.

        Between two beacons of a sensor without a visit or an overflow, the queue grows by the arrivals.
        """
        before = self._seen[ids]
        newer = (seen > before).nonzero()[0]
        if len(newer) < len(ids):
            ids, seen, queue, before = ids[newer], seen[newer], queue[newer], before[newer]
        last, undisturbed = self._queue[ids], (before >= 0) & (self.visits[ids] < before)
        grown = undisturbed & (last <= queue) & (queue < self._capacity)
        if len(of := ids[grown]):
            self._arrivals[of] += (queue - last)[grown]
            self._exposure[of] += (seen - before)[grown]
        self._seen[ids], self._queue[ids] = seen, queue

    def presume(self, sensor_id: int, decision_id: str, step: int) -> None:
        """Count a decision as a visit until its outcome is known."""
        self._open.setdefault(sensor_id, {})[decision_id] = step
        self._update(sensor_id)

    def confirm(self, sensor_id: int, decision_id: str, step: int) -> None:
        """Make the visit final: it succeeded, or its outcome will never be known."""
        self.confirmed[sensor_id] = max(self.confirmed[sensor_id], step)
        self.withdraw(sensor_id, decision_id)

    def withdraw(self, sensor_id: int, decision_id: str) -> None:
        """Drop the visit: the record returns to the latest remaining one."""
        waiting = self._open.get(sensor_id, {})
        waiting.pop(decision_id, None)
        if not waiting:
            self._open.pop(sensor_id, None)
        self._update(sensor_id)

    def _update(self, sensor_id: int) -> None:
        presumed = max(self._open.get(sensor_id, {}).values(), default=NEVER)
        self.visits[sensor_id] = max(int(self.confirmed[sensor_id]), presumed)

    def state_dict(self) -> dict[str, Any]:
        """The whole state, as copies."""
        return {
            "visits": self.visits.copy(),
            "confirmed": self.confirmed.copy(),
            "open": {sensor: dict(waiting) for sensor, waiting in self._open.items()},
            "seen": self._seen.copy(),
            "queue": self._queue.copy(),
            "arrivals": self._arrivals.copy(),
            "exposure": self._exposure.copy(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state."""
        self.visits, self.confirmed, self._open = state["visits"], state["confirmed"], state["open"]
        self._seen, self._queue = state["seen"], state["queue"]
        self._arrivals, self._exposure = state["arrivals"], state["exposure"]


def take_readings(
    ids: NDArray[np.int64],
    steps: NDArray[np.int64],
    queue: FloatArray,
    battery: FloatArray,
    records: Records,
    belief: FleetBelief,
) -> NDArray[np.bool_]:
    """Add sensors' own readings to their records and to the belief; returns which readings are new.

    A reading is new if it is later than the sensor's last beacon, reading and visit: the belief has already subtracted
    a visit's packets.

    Args:
        ids: shape ``(n,)``, each sensor once.
        steps: shape ``(n,)``, negative before the mission's first step.
        queue: shape ``(n,)``, packets at the start of that step.
        battery: shape ``(n,)``, joules; NaN if the reading has none.
    """
    latest = np.maximum(belief.heard[ids], belief.visited[ids])
    since = belief.since[ids]
    before = steps < 0
    new = np.where(before, (latest < 0) & ((since >= 0) | (steps > since)), steps > latest)
    battery = np.where(np.isnan(battery), belief.battery[ids], battery)
    first, now = new & before, new & ~before
    belief.begin(ids[first], steps[first], queue[first], battery[first])
    belief.hear(ids[now], belief.places[ids[now]], steps[now], queue[now], battery[now])
    records.hear(ids[now], steps[now], queue[now])
    return np.asarray(new)


def take_report(uav: UavState, step: int, records: Records, belief: FleetBelief) -> Measured:
    """Add a UAV's full report to the sensors' records and to the belief; returns the measurements of its gains.

    A report that was delayed, behind a later one of the UAV, has only beacons: its place would undo the later decision.
    """
    reported, last = arrays_of(uav.sensors), belief.uavs.get(uav.uav_id)
    delayed = last is not None and step < last.taught <= step + _LATE_STEPS
    belief.advance(step)
    if not delayed:
        belief.locate(uav.uav_id, step, uav.position, uav.progress_m)
    if uav.top_speed_mps is not None:
        belief.drift.tops[uav.uav_id] = max(1, round(uav.top_speed_mps))
    belief.hear(reported.ids, reported.places, reported.beacon, reported.queue, reported.battery)
    fresh = reported.beacon == step
    gains = reported.ids[fresh], reported.gain[fresh]
    measured = NOTHING_MEASURED if delayed else belief.measure(uav.uav_id, *gains)
    records.hear(reported.ids, reported.beacon, reported.queue)
    return measured

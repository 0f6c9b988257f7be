"""State augmentation: what a UAV reported, completed by what the edge knows, as arrays and features."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared.channel import FloatArray, channel_gain_db
from shared.scenario import Point, Scenario
from shared.urgency import urgency
from shared.wire import UavState

FEATURES = 5


@dataclass(frozen=True, slots=True)
class State:
    """One UAV's view at one step; arrays have shape ``(J,)``, ``places`` ``(J, 2)``, in the request's order.

    ``progress_m`` along the trajectory, if the UAV told it; ``queue`` packets, ``battery`` J, ``gain`` dB,
    ``since_visit`` steps, ``urgency`` 0..1, ``distance`` m from the UAV now. Sensors
    never heard (``heard`` false) hold zeros in what only a beacon tells.
    """

    position: Point
    progress_m: float | None
    places: FloatArray
    ids: NDArray[np.int64]
    heard: NDArray[np.bool_]
    admissible: NDArray[np.bool_]
    queue: FloatArray
    battery: FloatArray
    gain: FloatArray
    since_visit: FloatArray
    urgency: FloatArray
    distance: FloatArray

    def features(self, scenario: Scenario) -> NDArray[np.float32]:
        """Preset ``paper``, d = 5, admissible sensors only: ``[b/E0, q/W, h normalised, delta/T, U]``, each 0..1."""
        best = float(channel_gain_db(0.0, scenario))
        worst = -scenario.path_loss_limit_db
        columns = (
            self.battery / scenario.battery_j,
            self.queue / scenario.queue_capacity,
            (self.gain - worst) / max(best - worst, 1.0),
            self.since_visit / scenario.steps,
            self.urgency,
        )
        stacked = np.stack([np.clip(c[self.admissible], 0.0, 1.0) for c in columns], axis=1)
        return np.ascontiguousarray(stacked, dtype=np.float32)

    def normalised_distance(self, row: int, scenario: Scenario) -> float:
        """Distance of the sensor in that row in radio radii, at most 2."""
        return min(float(self.distance[row]) / scenario.radio_radius_m, 2.0)


def augment(
    uav: UavState,
    step: int,
    scenario: Scenario,
    *,
    visits: NDArray[np.int64],
    rates: FloatArray,
    reserved: Collection[int],
) -> State:
    """Complete a UAV's report with visiting records, urgency, and the channel from where it is now.

    A stale channel gain is replaced by the channel model's at the present distance: the place of a sensor does
    not change, so the model knows better than an old beacon. Admissible is a sensor heard, with a battery, and not
    reserved.

    Args:
        visits: step of each sensor's last visit (TVR_j), by sensor ID; one never visited counts from step 0.
        rates: observed arrival rates, packets a step, by sensor ID.
        reserved: sensors that other UAVs were given this step.
    """
    sensors = uav.sensors
    ids = np.asarray(sensors.id, dtype=np.int64)
    heard = np.array([s is not None for s in sensors.last_seen])
    fresh = np.array([s == step for s in sensors.last_seen])
    position = (uav.position[0], uav.position[1])
    places = np.stack((sensors.x, sensors.y), axis=1)
    distance = np.linalg.norm(places - position, axis=1)
    queue, battery = filled(sensors.queue), filled(sensors.battery)
    return State(
        position=position,
        progress_m=uav.progress_m,
        places=places,
        ids=ids,
        heard=heard,
        admissible=heard & (battery > 0) & ~np.isin(ids, list(reserved)),
        queue=queue,
        battery=battery,
        gain=np.where(fresh, filled(sensors.channel_gain), channel_gain_db(distance, scenario)),
        since_visit=np.maximum(step - np.maximum(visits[ids], 0), 0).astype(np.float64),
        urgency=urgency(queue, rates[ids], scenario),
        distance=distance,
    )


def filled(column: Sequence[float | None], missing: float = 0.0) -> FloatArray:
    """A column as an array ``(J,)``, with ``missing`` for nulls."""
    return np.array([missing if value is None else value for value in column], dtype=np.float64)

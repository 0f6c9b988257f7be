"""State augmentation: a UAV's report completed by the edge's knowledge, with urgencies and reach, as features."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from shared.belief.drift import Drift
from shared.belief.fleet_belief import FleetBelief
from shared.belief.learned_channel import LIKELY, ExpectedLinks, LearnedChannel
from shared.wire.schemas import Features, UavState
from shared.wire.sensor_arrays import SensorArrays, arrays_of
from shared.world.channel import FloatArray, best_gain_db, channel_gain_db
from shared.world.scenario import Point, Scenario
from shared.world.step_rule import least_joules_a_packet
from shared.world.trajectory import progress_of, trajectories
from shared.world.urgency import overflow_probability, urgency_of, with_bonus

# The number of features of a sensor in each preset.
FEATURES: dict[Features, int] = {"paper": 5, "reach": 12}
# The number of the velocity scorer's inputs for each velocity level.
LEVEL_FEATURES = 4


@dataclass(frozen=True, slots=True)
class Reach:
    """One UAV's reach after a step at each of V velocity levels to each of J sensors; arrays ``(V, J)``.

    ``links``: the expected transfers. ``packets`` that are expected to move, ``P(hold) min(q_j, packets)``, 0 for a
    sensor that was never heard or has a flat battery; ``worth`` in urgent packets, ``U_j packets + 0.5 v``. For each
    sensor, ``(J,)``, ``best`` is the velocity level of the greatest worth, and ``best_packets`` those packets.
    """

    links: ExpectedLinks
    packets: FloatArray
    worth: FloatArray
    best: NDArray[np.int64]
    best_packets: FloatArray

    @classmethod
    def of(cls, links: ExpectedLinks, queue: FloatArray, urgency: FloatArray) -> Self:
        """From links ``(V, J)``, queues and urgencies ``(J,)``; the queue is 0 for a sensor that cannot send."""
        # In place: of many sensors, new memory takes as long as the sums.
        packets = np.minimum(queue, links.packets)
        packets *= links.hold
        worth = with_bonus(urgency * packets, np.arange(len(packets)))
        best = worth.argmax(axis=0)
        return cls(links, packets, worth, best, packets[best, np.arange(len(best))])

    @property
    def likely(self) -> NDArray[np.bool_]:
        """Whether each link is likely to hold."""
        return np.asarray(self.links.hold >= LIKELY)


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """One UAV's view at one step; arrays have shape ``(J,)``, ``places`` ``(J, 2)``, in the request's order.

    ``progress_m`` along the trajectory, if the UAV reported it; ``queue`` packets, ``battery`` J, ``gain`` dB,
    ``rate`` packets a step, ``since_visit`` steps, ``overflow`` (the probability of one before the next visit) and
    ``urgency`` 0..1, ``distance`` m from the UAV now. A sensor never heard (``heard`` false) has zeros
    in the fields that only a beacon fills. A sensor is ``able`` that was heard and whose battery is not flat.
    ``channel`` and ``drift`` are the fleet's knowledge of its links and ways; without them they follow the formula.
    Only preset ``reach`` has ``reach``.
    """

    position: Point
    progress_m: float | None
    places: FloatArray
    ids: NDArray[np.int64]
    heard: NDArray[np.bool_]
    able: NDArray[np.bool_]
    admissible: NDArray[np.bool_]
    queue: FloatArray
    battery: FloatArray
    gain: FloatArray
    rate: FloatArray
    since_visit: FloatArray
    overflow: FloatArray
    urgency: FloatArray
    distance: FloatArray
    channel: LearnedChannel | None = None
    drift: Drift | None = None
    reach: Reach | None = None

    @property
    def overflow_risk(self) -> float:
        """Mean probability that a heard sensor overflows before its next visit, 0..1; 0 if none was heard."""
        heard = self.overflow[self.heard]
        # For a few numbers np.mean takes several times as long.
        return float(np.add.reduce(heard)) / len(heard) if len(heard) else 0.0

    def reach_ahead(self, uav_id: int, scenario: Scenario) -> Reach:
        """The UAV's reach after the next step, in any preset."""
        if self.reach is not None:
            return self.reach
        ahead = places_ahead(uav_id, self.position, self.progress_m, scenario, self.drift)
        links = self.links(ahead, distances_between(ahead, self.places), slice(None), scenario)
        return Reach.of(links, np.where(self.able, self.queue, 0.0), self.urgency)

    def links(
        self, places: FloatArray, distance: FloatArray, rows: NDArray[np.int64] | slice, scenario: Scenario
    ) -> ExpectedLinks:
        """The expected links from the UAV's places ``(P, 2)`` to the sensors in n rows, at distances ``(P, n)``."""
        if self.channel is None:
            return ExpectedLinks.by_formula(distance, scenario)
        return self.channel.links(places, distance, self.ids[rows])

    def features(self, scenario: Scenario) -> NDArray[np.float32]:
        """Attention's input for the n admissible sensors, ``(n, d)``, each number 0..1.

        Preset ``paper``, d = 5: ``[b/E0, q/W, h normalised, delta/T, U]``. Preset ``reach``, d = 12: these, and, at the
        best velocity, packets / W, urgent packets / W, and that velocity / max; then steps until overflow / T, the
        probabilities that the link holds at velocity 0 and at full speed, and half the distance at velocity 0 in radio
        radii.
        """
        best, worst, capacity = best_gain_db(scenario), -scenario.path_loss_limit_db, scenario.queue_capacity
        columns = [
            self.battery / scenario.battery_j,
            self.queue / capacity,
            (self.gain - worst) / max(best - worst, 1.0),
            self.since_visit / scenario.steps,
            self.urgency,
        ]
        if (reach := self.reach) is not None:
            packets, room = reach.best_packets / capacity, capacity - self.queue
            columns += [
                packets,
                self.urgency * packets,
                reach.best / scenario.max_velocity,
                # A sensor without arrivals never overflows.
                np.divide(room, self.rate, out=np.full_like(room, np.inf), where=self.rate > 0) / scenario.steps,
                reach.links.hold[0],
                reach.links.hold[-1],
                reach.links.distance[0] / scenario.radio_radius_m / 2,
            ]
        stacked = np.array(columns, dtype=np.float32)
        np.maximum(stacked, 0.0, out=stacked)
        np.minimum(stacked, 1.0, out=stacked)
        return stacked.T.take(np.flatnonzero(self.admissible), axis=0)

    def approaches(self, rows: Sequence[int], scenario: Scenario) -> NDArray[np.float32]:
        """The velocity scorer's inputs for the sensors in n rows, beside their contexts.

        Preset ``paper``: the distance in radio radii, at most 2, ``(n, 1)``. Preset ``reach``: at each level packets /
        W, urgent packets / W, velocity / max, and the distance in radio radii, at most 2, ``(n, V, 4)``.
        """
        if (reach := self.reach) is None:
            return np.minimum(self.distance[rows] / scenario.radio_radius_m, 2.0)[:, None].astype(np.float32)
        packets = reach.packets[:, rows].T / scenario.queue_capacity
        # For a few numbers np.stack takes several times as long.
        inputs = np.empty((*packets.shape, LEVEL_FEATURES), dtype=np.float32)
        inputs[..., 0], inputs[..., 1] = packets, self.urgency[rows][:, None] * packets
        inputs[..., 2] = np.arange(len(reach.packets)) / scenario.max_velocity
        inputs[..., 3] = np.minimum(reach.links.distance[:, rows].T / scenario.radio_radius_m, 2.0)
        return inputs


def augment(
    uav: UavState,
    step: int,
    scenario: Scenario,
    *,
    visits: NDArray[np.int64],
    rates: FloatArray | None,
    reserved: Collection[int],
    preset: Features = "paper",
    belief: FleetBelief | None = None,
) -> State:
    """Complete a UAV's report with visiting records, urgency, and the channel at its present position.

    Admissible is a sensor heard, with a battery, and not reserved. With a fleet's belief, queues and batteries are the
    values that the fleet expects now, and a sensor that no UAV has heard counts as heard, with its expected queue.

    Args:
        visits: step of each sensor's last visit (TVR_j), by sensor ID; a sensor never visited counts from step 0.
        rates: observed arrival rates, packets a step, by sensor ID; a belief has its own.
        reserved: sensors that other UAVs have in this step.
        preset: ``reach`` also looks ahead along the UAV's trajectory.
        belief: the fleet's; without it the state has this UAV's own last beacons.
    """
    reported = arrays_of(uav.sensors)
    ids, places, queue, battery = reported.ids, reported.places, reported.queue, reported.battery
    heard = reported.beacon >= 0
    position = (uav.position[0], uav.position[1])
    east, north = places[:, 0] - position[0], places[:, 1] - position[1]
    distance = np.sqrt(east * east + north * north)
    if belief is None:
        assert rates is not None
        rate, battery = rates[ids], np.where(battery < least_joules_a_packet(scenario), 0.0, battery)
    else:
        heard = np.ones_like(heard)
        battery, queue = belief.battery[ids], belief.queue(step, ids)
        rate = belief.arrivals.coming(step, scenario.overflow_horizon_steps, ids)
    able = heard & (battery > 0)
    # Few sensors are reserved: for them np.isin takes several times as long.
    admissible = able.copy()
    for sensor in reserved:
        admissible[ids == sensor] = False
    overflow = overflow_probability(queue, rate, scenario)
    state = State(
        position=position,
        progress_m=uav.progress_m,
        places=places,
        ids=ids,
        heard=heard,
        able=able,
        admissible=admissible,
        queue=queue,
        battery=battery,
        gain=_gains_now(reported, distance, position, step, scenario, None if belief is None else belief.channel),
        rate=rate,
        since_visit=np.maximum(step - np.maximum(visits[ids], 0), 0).astype(np.float64),
        overflow=overflow,
        urgency=urgency_of(queue, overflow, scenario),
        distance=distance,
        channel=None if belief is None else belief.channel,
        drift=None if belief is None else belief.drift,
    )
    return replace(state, reach=state.reach_ahead(uav.uav_id, scenario)) if preset == "reach" else state


def _gains_now(
    reported: SensorArrays,
    distance: FloatArray,
    position: Point,
    step: int,
    scenario: Scenario,
    channel: LearnedChannel | None,
) -> FloatArray:
    """The gains at the present distances, dB; expected where the beacon is old, since no sensor moves."""
    stale = reported.beacon != step
    if not stale.any():
        return reported.gain
    gain, far = reported.gain.copy(), distance[stale]
    if channel is None:
        gain[stale] = channel_gain_db(far, scenario)
    else:
        gain[stale] = channel.gain_db(np.asarray(position), far, reported.ids[stale])
    return gain


def places_ahead(
    uav: int, position: Point, progress_m: float | None, scenario: Scenario, drift: Drift | None = None
) -> FloatArray:
    """A UAV's places after one step at each of the V velocity levels, m, ``(V, 2)``.

    A UAV off its scenario's trajectory flies an unknown one: its places are then the present one. Without a drift the
    UAV flies ``v dt``; with one, at most its top speed.
    """
    velocities = np.arange(scenario.max_velocity + 1)
    if drift is not None:
        velocities = np.minimum(velocities, drift.fastest([uav], scenario.max_velocity))
    path = trajectories(scenario)[uav]
    progress = progress_of(path, position, progress_m)
    if progress is None:
        return np.broadcast_to(np.asarray(position, dtype=np.float64), (len(velocities), 2))
    still = np.asarray(velocities * scenario.step_s, dtype=np.float64)
    return path.at(progress + (still if drift is None or drift.none else drift.flown(path, progress, still)))


def distances_between(ahead: FloatArray, places: FloatArray) -> FloatArray:
    """Distances of the UAV's places ``(V, 2)`` to the sensors' ``(J, 2)``, m, ``(V, J)``."""
    # numpy's norm of pairs takes three times as long as this computation by axis, in place.
    east, north = (places[None, :, axis] - ahead[:, None, axis] for axis in (0, 1))
    east *= east
    north *= north
    east += north
    return np.asarray(np.sqrt(east, out=east))

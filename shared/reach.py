"""A UAV's reach after its next step: the packets that it could move at each velocity, and the best velocity."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from shared.channel import FloatArray
from shared.drift import Drift
from shared.learned_channel import LIKELY, ExpectedLinks
from shared.scenario import Point, Scenario
from shared.trajectory import progress_of, trajectories

# The worth of a metre a second in urgent packets: while a UAV dwells at few packets, sensors further on overflow.
# On 30 worlds of scenario `paper`, 0.5 to 4 lost 54 to 61 packets, differences within their noise.
VELOCITY_BONUS = 0.5
# The number of the velocity scorer's inputs for each velocity level.
LEVEL_FEATURES = 4


def places_ahead(
    uav: int, position: Point, progress_m: float | None, scenario: Scenario, drift: Drift | None = None
) -> FloatArray:
    """A UAV's places after one step at each of the V velocity levels, m, ``(V, 2)``.

    A UAV off its scenario's trajectory flies an unknown one: its places are then the present one. Without a drift the
    UAV flies ``v dt``.
    """
    velocities = np.arange(scenario.max_velocity + 1)
    path = trajectories(scenario)[uav]
    progress = progress_of(path, position, progress_m)
    if progress is None:
        return np.broadcast_to(np.asarray(position, dtype=np.float64), (len(velocities), 2))
    still = np.asarray(velocities * scenario.step_s, dtype=np.float64)
    return path.at(progress + (still if drift is None or drift.none else drift.flown(path, progress, still)))


def distances_between(ahead: FloatArray, places: FloatArray) -> FloatArray:
    """Distances of the UAV's places ``(V, 2)`` to the sensors' ``(J, 2)``, m, ``(V, J)``."""
    # numpy's norm of pairs takes three times as long as this computation by axis.
    east, north = (places[None, :, axis] - ahead[:, None, axis] for axis in (0, 1))
    return np.asarray(np.sqrt(east * east + north * north))


@dataclass(frozen=True)
class Reach:
    """One UAV's reach after a step at each of V velocity levels to each of J sensors; arrays ``(V, J)``.

    ``links``: the expected transfers. ``packets`` that are expected to move, ``P(hold) min(q_j, packets)``, 0 for a
    sensor that was never heard or has a flat battery; ``worth`` in urgent packets, ``U_j packets + 0.5 v``.
    """

    links: ExpectedLinks
    packets: FloatArray
    worth: FloatArray

    @classmethod
    def of(cls, links: ExpectedLinks, queue: FloatArray, urgency: FloatArray) -> Self:
        """From links ``(V, J)``, queues and urgencies ``(J,)``; the queue is 0 for a sensor that cannot send."""
        packets = links.movable(queue)
        velocities = np.arange(len(packets), dtype=np.float64)
        return cls(links, packets, urgency * packets + VELOCITY_BONUS * velocities[:, None])

    @property
    def distance(self) -> FloatArray:
        """Metres."""
        return self.links.distance

    @property
    def likely(self) -> NDArray[np.bool_]:
        """Whether each link is likely to hold."""
        return np.asarray(self.links.hold >= LIKELY)

    @cached_property
    def best(self) -> NDArray[np.int64]:
        """For each sensor the velocity level of the greatest worth, ``(J,)``."""
        return np.asarray(self.worth.argmax(axis=0))

    @cached_property
    def best_packets(self) -> FloatArray:
        """The packets that the UAV could move at the best velocity, ``(J,)``."""
        return np.asarray(np.take_along_axis(self.packets, self.best[None], axis=0)[0])

    def sensor_features(self, urgency: FloatArray, overflow_in: FloatArray, scenario: Scenario) -> FloatArray:
        """The features of preset ``reach`` beside preset ``paper``'s five, ``(J, 7)``, each 0..1.

        They are, at the best velocity, packets / W, urgent packets / W, and that velocity / max; then steps until
        overflow / T, the probabilities that the link holds at velocity 0 and at full speed, and half the distance at
        velocity 0 in radio radii.

        Args:
            urgency: U, ``(J,)``.
            overflow_in: ``(W - q) / rate``, steps, ``(J,)``.
        """
        packets = self.best_packets / scenario.queue_capacity
        holds = self.links.holding([0, -1])
        columns = (
            packets,
            urgency * packets,
            self.best / scenario.max_velocity,
            overflow_in / scenario.steps,
            holds[0],
            holds[1],
            self.distance[0] / scenario.radio_radius_m / 2,
        )
        return np.asarray(np.clip(np.stack(columns, axis=1), 0.0, 1.0))

    def level_features(self, row: int, urgency: float, scenario: Scenario) -> NDArray[np.float32]:
        """The velocity scorer's inputs for one sensor in preset ``reach``, ``(V, 4)``.

        They are at each level packets / W, urgent packets / W, velocity / max, and the distance in radio radii, at
        most 2.
        """
        packets = self.packets[:, row] / scenario.queue_capacity
        levels = np.arange(len(packets)) / scenario.max_velocity
        distance = np.minimum(self.distance[:, row] / scenario.radio_radius_m, 2.0)
        return np.stack((packets, urgency * packets, levels, distance), axis=1).astype(np.float32)

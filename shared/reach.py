"""A UAV's reach after its next step: the packets that it could move at each velocity, and the best velocity."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from shared.channel import FloatArray, link_holds, packets_per_step
from shared.scenario import Point, Scenario
from shared.trajectory import progress_of, trajectories

# The worth of a metre a second in urgent packets: while a UAV dwells at few packets, sensors further on overflow.
# On 30 worlds of scenario `paper`, 0.5 to 4 lost 54 to 61 packets, differences within their noise.
VELOCITY_BONUS = 0.5
# The number of the velocity scorer's inputs for each velocity level.
LEVEL_FEATURES = 4


def distances_ahead(
    uav: int, position: Point, progress_m: float | None, places: FloatArray, scenario: Scenario
) -> FloatArray:
    """Distances after one step at each of the V velocity levels to each of the J places, m, ``(V, J)``.

    A UAV off its scenario's trajectory flies an unknown one: the distances are then from its present position.

    Args:
        places: ``(J, 2)``, metres.
    """
    velocities = np.arange(scenario.max_velocity + 1)
    path = trajectories(scenario)[uav]
    progress = progress_of(path, position, progress_m)
    if progress is None:
        ahead = np.broadcast_to(np.asarray(position, dtype=np.float64), (len(velocities), 2))
    else:
        ahead = path.at(progress + velocities * scenario.step_s)
    # numpy's norm of pairs takes three times as long as this computation by axis.
    east, north = (places[None, :, axis] - ahead[:, None, axis] for axis in (0, 1))
    return np.asarray(np.sqrt(east * east + north * north))


@dataclass(frozen=True)
class Reach:
    """One UAV's reach after a step at each of V velocity levels to each of J sensors; arrays ``(V, J)``.

    ``distance`` m; ``packets`` that the UAV could move, ``min(q_j, packets_per_step)``, 0 for a sensor that was never
    heard or has a flat battery; ``worth`` in urgent packets, ``U_j packets + 0.5 v``.
    """

    distance: FloatArray
    packets: FloatArray
    worth: FloatArray

    @classmethod
    def of(cls, distance: FloatArray, queue: FloatArray, urgency: FloatArray, scenario: Scenario) -> Self:
        """From distances ``(V, J)``, queues and urgencies ``(J,)``; the queue is 0 for a sensor that cannot send."""
        packets = np.minimum(queue, packets_per_step(distance, scenario)).astype(np.float64)
        velocities = np.arange(len(distance), dtype=np.float64)
        return cls(distance, packets, urgency * packets + VELOCITY_BONUS * velocities[:, None])

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
        overflow / T, in reach at velocity 0, in reach at full speed, and half the distance at velocity 0 in radio
        radii.

        Args:
            urgency: U, ``(J,)``.
            overflow_in: ``(W - q) / rate``, steps, ``(J,)``.
        """
        packets = self.best_packets / scenario.queue_capacity
        holds = link_holds(self.distance[[0, -1]], scenario)
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

"""Worlds of one scenario that step together, in numpy; :class:`PipelineWorld` is a batch of one."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, Self, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared.world.channel import FloatArray, IntArray, Links
from shared.world.scenario import SCENARIOS, Scenario
from shared.world.step_rule import joules_a_packet, transfer
from shared.world.trajectory import Trajectory, trajectories
from simulator.world.gain_trace import GainTrace
from simulator.world.observation import Observation, StepTally
from simulator.world.sensors import Sensors, Streams
from simulator.world.truth import Truth

_T = TypeVar("_T")


@dataclass(frozen=True, eq=False)
class Fleet:
    """I UAVs, each on its trajectory; of B worlds both arrays have a first dimension B.

    Attributes:
        trajectories: one a UAV.
        start_m: shape ``(I,)``, arc length from each trajectory's beginning to the UAV's start.
        progress_m: shape ``(I,)``, ``start_m`` plus the distance flown.
    """

    trajectories: tuple[Trajectory, ...]
    start_m: FloatArray
    progress_m: FloatArray

    @classmethod
    def draw(cls, scenario: Scenario, rng: np.random.Generator) -> Self:
        """A scenario's fleet, each start uniform along its trajectory."""
        paths = trajectories(scenario)
        start_m = rng.uniform(0.0, 1.0, len(paths)) * [path.length_m for path in paths]
        return cls(paths, start_m, start_m)

    @property
    def positions(self) -> FloatArray:
        """The UAVs' current positions, shape ``(I, 2)``, metres."""
        return self.at(self.progress_m)

    def at(self, progress_m: ArrayLike) -> FloatArray:
        """The UAVs' positions at arc lengths ``(..., I)`` along their trajectories, ``(..., I, 2)``, metres."""
        progress = np.asarray(progress_m, dtype=np.float64)
        return np.stack([path.at(progress[..., uav]) for uav, path in enumerate(self.trajectories)], axis=-2)


@dataclass(frozen=True, eq=False)
class BatchStep:
    """The outcome of one step of every world: the fields of ``Info`` per UAV, and those of ``StepTally`` per world.

    Every number of a UAV that left before the step is 0.

    Attributes:
        failed: f, ``(B, I)``.
        moved: packets collected by each UAV, ``(B, I)``.
        blamed: packets lost at the sensors with a usable link to the UAV, ``(B, I)``.
        cost: c, ``(B, I)``.
        overflows: sensors that overflowed, ``(B,)``.
        lost_packets: ``(B,)``.
        collected: packets collected from each sensor, ``(B, J)``.
    """

    failed: IntArray
    moved: IntArray
    blamed: IntArray
    cost: FloatArray
    overflows: IntArray
    lost_packets: IntArray
    collected: IntArray

    def tally(self, world: int, step: int) -> StepTally:
        """The step of one of the worlds."""
        failures, overflows = int(self.failed[world].sum()), int(self.overflows[world])
        return StepTally(step, failures, overflows, int(self.lost_packets[world]), self.collected[world])


@dataclass(frozen=True, eq=False)
class Draw:
    """The random part of one world, or of B worlds, as it is drawn from their seeds."""

    sensors: Sensors
    fleet: Fleet
    truth: Truth

    @classmethod
    def one(
        cls,
        scenario: Scenario,
        root: np.random.SeedSequence,
        trace: IntArray | None = None,
        gains: GainTrace | None = None,
    ) -> "Draw":
        """The world of a seed; the traces of arrivals and gains act as they do in ``PipelineWorld``."""
        streams = Streams.of(root)
        return cls(
            Sensors.draw(scenario, streams, trace),
            Fleet.draw(scenario, streams.angles),
            Truth.draw(scenario, streams, gains),
        )


def stacked(worlds: Sequence[_T]) -> _T:
    """A part of each of B worlds as the same part of all: its arrays get a first dimension B."""
    first: Any = worlds[0]
    if isinstance(first, np.ndarray):
        # For a few small arrays np.stack takes several times as long.
        return np.array(worlds)  # type: ignore[return-value]
    if not is_dataclass(first):
        return worlds[0]
    parts = {field.name: stacked([getattr(world, field.name) for world in worlds]) for field in fields(first)}
    return cast(_T, replace(cast(Any, first), **parts))


class VectorWorld:
    """B worlds that step together, by the rules in :class:`PipelineWorld`.

    All worlds have the scenario's T steps and end together. The entries of an observation have leading dimensions
    ``(B, I)``; those of a UAV that left mean nothing. They are the world's own arrays, not copies, and are valid until
    the next step. Attributes besides ``scenario``: ``steps_flown``, and of the B worlds the true ``sensors`` and the
    ``fleet``.
    """

    def __init__(self, scenario: Scenario = SCENARIOS["paper"]) -> None:
        self.scenario = scenario
        self.steps_flown = 0
        self.sensors: Sensors
        self.fleet: Fleet
        self._truth: Truth | None = None

    def start(self, draw: Draw) -> Observation:
        """Begin B worlds that are drawn already, and return the first observations."""
        self._truth = draw.truth
        self.steps_flown = 0
        self.sensors, self.fleet = draw.sensors.copy(), draw.fleet
        shape = (*draw.fleet.start_m.shape, self.scenario.sensors)
        # Of a UAV's link to the sensor that it names.
        self._rows = np.arange(shape[0])[:, None], np.arange(shape[1])
        self._heard_queue, self._heard_battery, self._heard_gain = np.zeros((3, *shape))
        self._last_heard: IntArray = np.full(shape, -1)
        # The place among the sensors of all worlds, for each entry of the observations.
        self._sensor_of: IntArray = np.broadcast_to(np.arange(draw.sensors.queue.size).reshape(-1, 1, shape[2]), shape)
        self._surveyed = np.broadcast_to(draw.sensors.positions[:, None], (*shape, 2))
        return self._observe(*self._links(draw.truth), np.zeros(shape, dtype=np.bool_))

    def fly(self, chosen: IntArray, velocity: IntArray) -> tuple[Observation, BatchStep]:
        """Fly one step of every world.

        Args:
            chosen: the sensor that each UAV collects from, ``(B, I)``, in 0..J - 1.
            velocity: of each UAV, m/s, ``(B, I)``, within the scenario's.
        """
        assert self._truth is not None
        truth, fleet, ground = self._truth, self.fleet, self.sensors
        scenario, step = self.scenario, self.steps_flown
        present = truth.faults.present(step)
        flown = truth.wind.flown_m(velocity * present, fleet.progress_m, fleet.trajectories, step)
        self.fleet = Fleet(fleet.trajectories, fleet.start_m, fleet.progress_m + flown)
        self.steps_flown += 1
        position, links = self._links(truth)
        named, before = links[(*self._rows, chosen)], ground.queue.copy()
        joules = joules_a_packet(named.rate_bps, scenario)
        served, moved = transfer(ground.queue, ground.battery, chosen, named.hold & present, named.packets, joules)
        failed, collected = (present & ~served).astype(np.int64), before - ground.queue
        lost = ground.arrive(step, scenario.queue_capacity)
        blamed = np.matmul(links.hold, lost[:, :, None])[:, :, 0] * present
        overflows, lost_packets = np.add.reduce(lost > 0, axis=1), np.add.reduce(lost, axis=1)
        cost = failed + blamed / scenario.queue_capacity
        outcome = BatchStep(failed, moved, blamed, cost, overflows, lost_packets, collected)
        status = np.zeros(links.distance_m.shape, dtype=np.bool_)
        status[(*self._rows, chosen)] = served
        return self._observe(position, links, status), outcome

    def _links(self, truth: Truth) -> tuple[FloatArray, Links]:
        """The UAVs' positions, and the links of every UAV to every sensor, ``(B, I, J)``."""
        position, sensors = self.fleet.positions, self.sensors.positions[:, None]
        distance = np.hypot(position[..., 0, None] - sensors[..., 0], position[..., 1, None] - sensors[..., 1])
        return position, truth.channel.links(distance, position, self.fleet.progress_m, self.steps_flown)

    def _observe(self, position: FloatArray, links: Links, served: NDArray[np.bool_]) -> Observation:
        """Record the beacons in range, or only the status of the sensors served, and return all observations."""
        assert self._truth is not None
        beacons = self.scenario.observation_model == "beacons"
        heard = np.flatnonzero(links.distance_m <= self.scenario.radio_radius_m if beacons else served)
        sensor = self._sensor_of.take(heard)
        self._heard_queue.put(heard, self.sensors.queue.take(sensor))
        self._heard_battery.put(heard, self.sensors.battery.take(sensor))
        self._heard_gain.put(heard, links.gain_db.take(heard))
        self._last_heard.put(heard, self.steps_flown)
        return Observation(
            step=np.full((*position.shape[:2], 1), self.steps_flown),
            position=self._truth.reported(position, self.steps_flown),
            progress=self.fleet.progress_m[..., None],
            sensor_position=self._surveyed,
            queue=self._heard_queue,
            battery=self._heard_battery,
            channel_gain=self._heard_gain,
            last_heard=self._last_heard,
        )

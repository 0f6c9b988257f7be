"""A batch of worlds of one scenario in numpy, for training: the numbers of :class:`PipelineWorld` to the bit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared.world.channel import FloatArray, IntArray
from shared.world.scenario import SCENARIOS, Scenario
from simulator.world.fleet import Fleet
from simulator.world.gain_trace import GainTrace
from simulator.world.observation import Cost
from simulator.world.sensors import Sensors, Streams
from simulator.world.truth import Truth


class BatchObservation(TypedDict):
    """The observations of all UAVs of all worlds: the entries of ``Observation`` with leading dimensions ``(B, I)``.

    Those of a UAV that left mean nothing.
    """

    step: IntArray
    position: FloatArray
    progress: FloatArray
    sensor_position: FloatArray
    queue: FloatArray
    battery: FloatArray
    channel_gain: FloatArray
    last_heard: IntArray


@dataclass(frozen=True, eq=False)
class BatchStep:
    """The outcome of one step of every world: the fields of ``Info`` per UAV, and those of ``StepTally`` per world.

    Every number of a UAV that left before the step is 0.

    Attributes:
        failed: f, ``(B, I)``.
        moved: packets collected by each UAV, ``(B, I)``.
        blamed: packets lost at the sensors with a usable link to the UAV, ``(B, I)``.
        reward: minus the cost, ``(B, I)``.
        overflows: sensors that overflowed, ``(B,)``.
        lost_packets: ``(B,)``.
        collected: packets collected from each sensor, ``(B, J)``.
    """

    failed: IntArray
    moved: IntArray
    blamed: IntArray
    reward: FloatArray
    overflows: IntArray
    lost_packets: IntArray
    collected: IntArray

    @property
    def failures(self) -> IntArray:
        """Failed transmissions of each world, ``(B,)``."""
        return np.asarray(self.failed.sum(axis=1))

    @property
    def events(self) -> IntArray:
        """Eq. 5's loss of each world, ``(B,)``."""
        return self.failures + self.overflows


@dataclass(frozen=True, eq=False)
class Draw:
    """The random part of B worlds, as ``PipelineWorld.reset`` draws it from each seed.

    ``positions`` ``(B, J, 2)`` and ``start_m`` ``(B, I)``, metres; ``initial_queue`` ``(B, J)`` and ``arrivals``
    ``(B, T, J)``, packets; ``truth``, of the B worlds.
    """

    positions: FloatArray
    initial_queue: IntArray
    arrivals: IntArray
    start_m: FloatArray
    truth: Truth

    @classmethod
    def of(
        cls, scenario: Scenario, seeds: Sequence[int], trace: IntArray | None = None, gains: GainTrace | None = None
    ) -> Draw:
        """The worlds of these seeds; the traces of arrivals and gains act as they do in ``PipelineWorld``."""
        streams = [Streams.of(np.random.SeedSequence(int(seed))) for seed in seeds]
        sensors = [Sensors(scenario, stream, trace) for stream in streams]
        return cls(
            positions=np.stack([one.positions for one in sensors]),
            initial_queue=np.stack([one.initial_queue for one in sensors]),
            arrivals=np.stack([one.arrivals for one in sensors]),
            start_m=np.stack([Fleet.draw(scenario, stream.angles).start_m for stream in streams]),
            truth=Truth.stack([Truth.draw(scenario, stream, gains) for stream in streams]),
        )


class VectorWorld:
    """B worlds that step together, with the rules and the numbers of :class:`PipelineWorld`.

    All worlds have the scenario's T steps and end together. Observations are the world's own arrays, not copies, and
    are valid until the next ``step``. Attributes besides ``scenario`` and ``cost``: ``steps_flown``, and the true
    ``queue`` ``(B, J)`` and ``battery`` ``(B, J)``.

    Args:
        arrivals: a trace, shape ``(at least T, J)``, instead of drawn arrivals.
        gains: recorded excess losses, beside the drawn ones.
        cost: the negative of the reward; see :class:`PipelineWorld`.

    Raises:
        ValueError: ``step`` before ``reset`` or past step T, actions of another shape or out of bounds, or an unknown
            cost.
    """

    def __init__(
        self,
        scenario: Scenario = SCENARIOS["paper"],
        *,
        arrivals: IntArray | None = None,
        gains: GainTrace | None = None,
        cost: Cost = "default",
    ) -> None:
        if cost not in ("default", "paper"):
            raise ValueError(f"unknown cost {cost!r}: choose one of default, paper")
        self.scenario = scenario
        self.cost = cost
        self.steps_flown = 0
        self.queue: IntArray
        self.battery: FloatArray
        self._trace = arrivals
        self._gains = gains
        self._fleet = Fleet.draw(scenario, np.random.default_rng(0))
        self._draw: Draw | None = None

    def reset(self, seeds: Sequence[int]) -> BatchObservation:
        """Draw one world a seed, and return the first observations."""
        return self.start(Draw.of(self.scenario, seeds, self._trace, self._gains))

    def start(self, draw: Draw) -> BatchObservation:
        """Begin worlds that are drawn already, and return the first observations."""
        self._draw = draw
        self.steps_flown = 0
        self.queue = draw.initial_queue.copy()
        self.battery = np.full(draw.initial_queue.shape, self.scenario.battery_j)
        self._progress = draw.start_m
        self._world = np.arange(len(draw.start_m))
        shape = (*draw.start_m.shape, self.scenario.sensors)
        self._heard_queue, self._heard_battery, self._heard_gain = np.zeros((3, *shape))
        self._last_heard: IntArray = np.full(shape, -1)
        # Row b * J + j of the flattened true state, for entry (b, i, j) of the UAVs' observations.
        columns = np.arange(draw.initial_queue.size).reshape(-1, 1, shape[-1])
        self._row_of: IntArray = np.broadcast_to(columns, shape).ravel()
        self._update_links(0)
        return self._observe()

    def step(self, sensors: ArrayLike, velocities: ArrayLike) -> tuple[BatchObservation, BatchStep]:
        """Fly one step of every world.

        Args:
            sensors: the sensor that each UAV collects from, integers ``(B, I)``.
            velocities: of each UAV, m/s, integers ``(B, I)``.
        """
        draw, chosen, velocity = self._checked(np.asarray(sensors), np.asarray(velocities))
        present = draw.truth.faults.present(self.steps_flown)
        paths = self._fleet.trajectories
        flown = draw.truth.wind.flown_m(velocity * present, self._progress, paths, self.steps_flown)
        self._progress = self._progress + flown
        self._update_links(self.steps_flown + 1)
        failed, moved, collected = self._collect(chosen, present)
        filled = self.queue + draw.arrivals[:, self.steps_flown]
        self.queue = np.minimum(filled, self.scenario.queue_capacity)
        lost: IntArray = filled - self.queue
        blamed = np.matmul(self._usable, lost[:, :, None])[:, :, 0] * present
        overflows, lost_packets = np.count_nonzero(lost, axis=1), lost.sum(axis=1)
        if self.cost == "paper":
            events = (failed.sum(axis=1) + overflows).astype(np.float64)
            cost = events[:, None] * present
        else:
            cost = failed + blamed / self.scenario.queue_capacity
        self.steps_flown += 1
        return self._observe(), BatchStep(failed, moved, blamed, -cost, overflows, lost_packets, collected)

    def state(self) -> NDArray[np.float32]:
        """``PipelineWorld.state()`` of every world, ``(B, 1 + 2 I + 4 J)``.

        Raises:
            ValueError: before the first ``reset``.
        """
        if self._draw is None:
            raise ValueError("state before reset")
        worlds, side = len(self._world), self.scenario.area_m
        parts = (
            np.full((worlds, 1), self.steps_flown / self.scenario.steps),
            (self._position / side).reshape(worlds, -1),
            (self._draw.positions / side).reshape(worlds, -1),
            self.queue / self.scenario.queue_capacity,
            self.battery / self.scenario.battery_j,
        )
        return np.concatenate(parts, axis=1).astype(np.float32)

    def _checked(self, sensors: IntArray, velocities: IntArray) -> tuple[Draw, IntArray, IntArray]:
        if self._draw is None:
            raise ValueError("step before reset")
        if self.steps_flown == self.scenario.steps:
            raise ValueError("step after the missions' end: reset first")
        shape = self._draw.start_m.shape
        last_sensor, fastest = self.scenario.sensors - 1, self.scenario.max_velocity
        for name, values, last in (("sensors", sensors, last_sensor), ("velocities", velocities, fastest)):
            if values.shape != shape or values.dtype.kind not in "iu":
                raise ValueError(f"{name} of shape {values.shape} and type {values.dtype}, not integers {shape}")
            if values.min() < 0 or values.max() > last:
                raise ValueError(f"{name} are not all in 0..{last}")
        return self._draw, sensors.astype(np.int64, copy=False), velocities

    def _update_links(self, instant: int) -> None:
        """Update the UAVs' positions, their distances to the sensors, the sensors heard and the usable links."""
        assert self._draw is not None
        self._position = self._fleet.at(self._progress)
        sensors = self._draw.positions[:, None]
        self._distance = np.hypot(
            self._position[..., 0, None] - sensors[..., 0], self._position[..., 1, None] - sensors[..., 1]
        )
        # The path loss is the costliest number of a step, and is needed only within the radio radius.
        self._heard = np.flatnonzero(self._distance <= self.scenario.radio_radius_m)
        channel = self._draw.truth.channel
        self._excess = channel.excess_db(self._position, self._progress, instant)
        self._share = np.broadcast_to(channel.share(self._distance, instant), self._distance.shape)
        heard = self._heard
        links = channel.at(*(array.ravel()[heard] for array in (self._distance, self._excess, self._share)))
        self._gain = links.gain_db
        self._usable = np.zeros(self._distance.shape, dtype=np.bool_)
        self._usable.ravel()[heard] = links.hold

    def _collect(self, chosen: IntArray, present: NDArray[np.bool_]) -> tuple[IntArray, IntArray, IntArray]:
        """Serve the UAVs in order; returns f and the packets moved, each ``(B, I)``, and by sensor, ``(B, J)``."""
        assert self._draw is not None
        reach, excess, share, usable = (
            np.take_along_axis(of_all, chosen[..., None], axis=2)[..., 0]
            for of_all in (self._distance, self._excess, self._share, self._usable)
        )
        usable &= present
        budget = np.zeros(chosen.shape, dtype=np.int64)
        energy = np.full(chosen.shape, np.inf)
        links = self._draw.truth.channel.at(reach[usable], excess[usable], share[usable])
        budget[usable] = links.packets
        with np.errstate(divide="ignore"):
            airtime_s = self.scenario.packet_bits / links.rate_bps
        energy[usable] = self.scenario.transmit_power_w * airtime_s
        served = np.zeros(self.queue.shape, dtype=np.bool_)
        collected = np.zeros(self.queue.shape, dtype=np.int64)
        failed, moved = np.ones((2, *chosen.shape), dtype=np.int64)
        for uav in range(self.scenario.uavs):
            at = (self._world, chosen[:, uav])
            battery, cost = self.battery[at], energy[:, uav]
            # A queue's capacity limits it, so that the number fits an integer.
            affordable = np.minimum(np.floor(battery / cost + 1e-9), self.scenario.queue_capacity).astype(np.int64)
            able = (affordable >= 1) & usable[:, uav] & ~served[at]
            packets = np.where(able, np.minimum(np.minimum(self.queue[at], budget[:, uav]), affordable), 0)
            self.queue[at] -= packets
            spent = packets * np.where(able, cost, 0.0)
            self.battery[at] = np.where(able, np.maximum(0.0, battery - spent), battery)
            served[at] |= able
            collected[at] += packets
            failed[:, uav], moved[:, uav] = present[:, uav] & ~able, packets
        return failed, moved, collected

    def _observe(self) -> BatchObservation:
        """Record the beacons in range."""
        heard, row = self._heard, self._row_of[self._heard]
        self._heard_queue.ravel()[heard] = self.queue.ravel()[row]
        self._heard_battery.ravel()[heard] = self.battery.ravel()[row]
        self._heard_gain.ravel()[heard] = self._gain
        self._last_heard.ravel()[heard] = self.steps_flown
        assert self._draw is not None
        shape = self._last_heard.shape
        return BatchObservation(
            step=np.full((*shape[:2], 1), self.steps_flown),
            position=self._draw.truth.reported(self._position, self.steps_flown),
            progress=self._progress[..., None],
            sensor_position=np.broadcast_to(self._draw.positions[:, None], (*shape, 2)),
            queue=self._heard_queue,
            battery=self._heard_battery,
            channel_gain=self._heard_gain,
            last_heard=self._last_heard,
        )

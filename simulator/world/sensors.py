"""The ground sensors of one world: their positions, queues, arrivals and batteries."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple, Self

import numpy as np

from shared.world.channel import FloatArray, IntArray, Links
from shared.world.scenario import Scenario


class Streams(NamedTuple):
    """A world's random streams, one for each purpose, so that more draws of one never shift another."""

    layout: np.random.Generator
    rates: np.random.Generator
    queues: np.random.Generator
    angles: np.random.Generator
    arrivals: np.random.Generator
    # A stream's place in this order is its seed: new ones come last.
    shadowing: np.random.Generator
    route_shadowing: np.random.Generator
    fading: np.random.Generator
    bursts: np.random.Generator
    gusts: np.random.Generator
    position_noise: np.random.Generator
    faults: np.random.Generator

    @classmethod
    def of(cls, root: np.random.SeedSequence) -> Self:
        """The streams of a seed sequence that has not spawned before."""
        return cls(*(np.random.default_rng(child) for child in root.spawn(len(cls._fields))))


class Sensors:
    """The J sensors of one world; the constructor makes all their random draws.

    Attributes:
        positions: shape ``(J, 2)``, metres.
        rates: shape ``(J,)``, mean arrival rates, packets a step.
        arrivals: shape ``(T, J)``, packets that arrive in each step: a trace's, else Poisson of ``rates``, or of the
            rates in and between bursts.
        initial_queue: shape ``(J,)``, packets.
        queue: shape ``(J,)``, packets waiting now, 0..W.
        battery: shape ``(J,)``, joules left.
        lost: shape ``(J,)``, packets lost so far.

    Raises:
        ValueError: the trace does not cover the mission.
    """

    def __init__(self, scenario: Scenario, streams: Streams, trace: IntArray | None = None) -> None:
        self._scenario = scenario
        count, capacity = scenario.sensors, scenario.queue_capacity
        self.positions = draw_positions(scenario, streams.layout)
        self.rates: FloatArray = streams.rates.uniform(scenario.arrival_rate_min, scenario.arrival_rate_max, count)
        fewest = math.ceil(scenario.initial_queue_min * capacity - 1e-9)
        self.initial_queue: IntArray = streams.queues.integers(fewest, capacity, count, endpoint=True)
        drawn = trace
        if drawn is None:
            rates = self.rates if scenario.burst_factor == 1 else self.rates * draw_bursts(scenario, streams.bursts)
            drawn = streams.arrivals.poisson(rates, (scenario.steps, count))
        self.arrivals: IntArray = np.asarray(drawn[: scenario.steps], dtype=np.int64)
        if self.arrivals.shape != (scenario.steps, count):
            shape = self.arrivals.shape
            raise ValueError(f"the trace has shape {shape}, the mission is {scenario.steps} steps of {count} sensors")
        self.queue = self.initial_queue.copy()
        self.battery: FloatArray = np.full(count, scenario.battery_j)
        self.lost: IntArray = np.zeros(count, dtype=np.int64)

    def serve(self, chosen: IntArray, uavs: Iterable[int], links: Links) -> tuple[IntArray, IntArray]:
        """Let UAVs collect, in this order, each from its sensor; returns f and the packets moved, each ``(I,)``.

        ``chosen`` has shape ``(I,)``, the links ``(I, J)``. Both numbers of a UAV that is not among ``uavs`` are 0.
        """
        reach = links[np.arange(len(chosen)), chosen]
        usable, budget, rate = reach.hold.tolist(), reach.packets.tolist(), reach.rate_bps.tolist()
        failed, moved = np.zeros((2, len(chosen)), dtype=np.int64)
        served: set[int] = set()
        for uav in uavs:
            sensor, packets = int(chosen[uav]), None
            if usable[uav] and sensor not in served:
                packets = self.transmit(sensor, budget[uav], rate[uav])
            if packets is not None:
                served.add(sensor)
            failed[uav] = packets is None
            moved[uav] = packets or 0
        return failed, moved

    def transmit(self, sensor: int, packets: int, rate_bps: float) -> int | None:
        """Move up to ``packets`` out of a sensor's queue, and take the energy from its battery.

        The energy is transmit power x airtime, with airtime ``moved x packet_bits / rate``. The remaining battery
        limits the packets moved.

        Returns:
            The packets moved (0 from an empty queue), or ``None`` if the battery cannot pay for one packet, which at a
            rate of 0 no battery can.
        """
        airtime_s = self._scenario.packet_bits / rate_bps if rate_bps > 0 else math.inf
        energy = self._scenario.transmit_power_w * airtime_s
        affordable = math.floor(float(self.battery[sensor]) / energy + 1e-9)
        if affordable < 1:
            return None
        moved: int = min(int(self.queue[sensor]), packets, affordable)
        self.queue[sensor] -= moved
        self.battery[sensor] = max(0.0, float(self.battery[sensor]) - moved * energy)
        return moved

    def arrive(self, step: int) -> IntArray:
        """Add a step's arrivals, clip the queues to W, and return the packets lost, shape ``(J,)``."""
        filled: IntArray = self.queue + self.arrivals[step]
        self.queue = np.minimum(filled, self._scenario.queue_capacity)
        lost: IntArray = filled - self.queue
        self.lost = self.lost + lost
        return lost


def draw_positions(scenario: Scenario, rng: np.random.Generator) -> FloatArray:
    """Sensor positions of a scenario's layout, shape ``(J, 2)``, metres, inside the area.

    ``uniform``: independent over the area. ``pipeline``: at equal arc lengths along the polyline, from its
    first point to its last (a single sensor at its middle), each moved by up to the spread on each axis.
    ``surveyed``: the scenario's sites.
    """
    if scenario.layout == "surveyed":
        return np.array(scenario.sites, dtype=np.float64)
    shape = (scenario.sensors, 2)
    if scenario.layout == "uniform":
        return rng.uniform(0.0, scenario.area_m, shape)
    line = np.array(scenario.pipeline)
    reached = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))))
    stops = np.linspace(0.0, reached[-1], scenario.sensors) if scenario.sensors > 1 else reached[-1:] / 2
    along = np.stack([np.interp(stops, reached, line[:, axis]) for axis in (0, 1)], axis=-1)
    spread = scenario.pipeline_spread_m
    return np.clip(along + rng.uniform(-spread, spread, shape), 0.0, scenario.area_m)


def draw_bursts(scenario: Scenario, rng: np.random.Generator) -> FloatArray:
    """Each sensor's arrival rate in each step, over its mean rate, shape ``(T, J)``.

    Two states follow each other with geometric lengths of means ``burst_steps`` and ``calm_steps``; a mission begins
    in the stationary distribution. The factors of the states have the ratio ``burst_factor`` and the stationary mean 1.
    """
    burst, calm, factor = scenario.burst_steps, scenario.calm_steps, scenario.burst_factor
    between = (burst + calm) / (factor * burst + calm)
    inside = rng.random(scenario.sensors) < burst / (burst + calm)
    factors = np.empty((scenario.steps, scenario.sensors))
    for step, changes in enumerate(rng.random(factors.shape)):
        factors[step] = np.where(inside, factor * between, between)
        inside ^= changes < np.where(inside, 1.0 / burst, 1.0 / calm)
    return factors

"""The ground sensors of one world: their positions, queues, arrivals and batteries; the streams of random numbers."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import permutations
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.random.bit_generator import ISeedSequence
from numpy.typing import NDArray

from shared.world.channel import FloatArray, IntArray
from shared.world.scenario import Scenario
from shared.world.step_rule import arrive

# Worlds from which on seeding all at once is faster.
_MANY = 64
# Of numpy's SeedSequence.
_FILL = [np.uint32(0x43B0D7E5 * pow(0x931E8875, k, 2**32) % 2**32) for k in range(17)]
_DRAW = [np.uint32(0x8B51F9DD * pow(0x58F38DED, k, 2**32) % 2**32) for k in range(9)]


@dataclass(frozen=True, eq=False)
class StepNoise:
    """Normal numbers by instant, of one world or of B worlds: ``keys`` are their seeds, ``()`` or ``(B,)``."""

    keys: IntArray

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Self:
        """One world's."""
        return cls(np.asarray(rng.integers(2**63)))

    def normal(self, instant: int, shape: tuple[int, ...]) -> FloatArray:
        """Standard normal numbers of an instant, of that shape, or ``(B, *shape)``; one shape only, at one instant."""
        if self.keys.size < _MANY:
            seeds: Iterable[Any] = ([key, instant] for key in self.keys.ravel().tolist())
        else:
            seeds = map(_Seed, seeded(self.keys, instant))
        drawn = [np.random.Generator(np.random.PCG64(seed)).standard_normal(shape) for seed in seeds]
        return np.stack(drawn).reshape(*self.keys.shape, *shape)


@dataclass(slots=True)
class _Seed(ISeedSequence):
    words: NDArray[np.uint64]

    def generate_state(self, n_words: int, dtype: Any = None) -> NDArray[np.uint64]:
        return self.words


def seeded(keys: IntArray, instant: int) -> NDArray[np.uint64]:
    """``numpy.random.SeedSequence([key, instant]).generate_state(4, numpy.uint64)`` of each key, ``(B, 4)``.

    It is O'Neill's ``seed_seq_fe128`` (www.pcg-random.org, 2015); for 1,024 keys it takes a sixtieth of the time.
    """
    low, high = keys.view(np.uint32).reshape(-1, 2).T
    # A key below 2^32 is one word, not two.
    pool = [low, np.where(high, high, instant), np.where(high, instant, 0), np.zeros_like(low)]
    pool = [_hashed(words.astype(np.uint32), _FILL[k:]) for k, words in enumerate(pool)]
    for k, (source, into) in enumerate(permutations(range(4), 2), start=4):
        mixed = np.uint32(0xCA01F9DD) * pool[into] - np.uint32(0x4973F715) * _hashed(pool[source], _FILL[k:])
        pool[into] = mixed ^ (mixed >> 16)
    return np.stack([_hashed(pool[k % 4], _DRAW[k:]) for k in range(8)], axis=1).view(np.uint64)


def _hashed(words: NDArray[np.uint32], constants: Sequence[np.uint32]) -> NDArray[np.uint32]:
    mixed: NDArray[np.uint32] = (words ^ constants[0]) * constants[1]
    return mixed ^ (mixed >> np.uint32(16))


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


@dataclass(frozen=True, eq=False)
class Sensors:
    """The J sensors of one world; of B worlds every array has a first dimension B.

    Attributes:
        positions: shape ``(J, 2)``, metres.
        rates: shape ``(J,)``, mean arrival rates, packets a step.
        initial_queue: shape ``(J,)``, packets.
        arrivals: shape ``(T, J)``, packets that arrive in each step: a trace's, else Poisson of ``rates``, or of the
            rates in and between bursts.
        queue: shape ``(J,)``, packets waiting now, 0..W.
        battery: shape ``(J,)``, joules left.
        lost: shape ``(J,)``, packets lost so far.
    """

    positions: FloatArray
    rates: FloatArray
    initial_queue: IntArray
    arrivals: IntArray
    queue: IntArray
    battery: FloatArray
    lost: IntArray

    @classmethod
    def draw(cls, scenario: Scenario, streams: Streams, trace: IntArray | None = None) -> Self:
        """One world's, before the first step; raises ``ValueError`` if the trace does not cover the mission."""
        count, capacity = scenario.sensors, scenario.queue_capacity
        positions = draw_positions(scenario, streams.layout)
        rates = streams.rates.uniform(scenario.arrival_rate_min, scenario.arrival_rate_max, count)
        fewest = math.ceil(scenario.initial_queue_min * capacity - 1e-9)
        most = max(fewest, math.floor(scenario.initial_queue_max * capacity + 1e-9))
        queue = streams.queues.integers(fewest, most, count, endpoint=True)
        drawn = trace
        if drawn is None:
            bursts = 1.0 if scenario.burst_factor == 1 else draw_bursts(scenario, streams.bursts)
            drawn = streams.arrivals.poisson(rates * bursts, (scenario.steps, count))
        arrivals = np.asarray(drawn[: scenario.steps], dtype=np.int64)
        if (shape := arrivals.shape) != (scenario.steps, count):
            raise ValueError(f"the trace has shape {shape}, the mission is {scenario.steps} steps of {count} sensors")
        battery, lost = np.full(count, scenario.battery_j), np.zeros(count, dtype=np.int64)
        return cls(positions, rates, queue, arrivals, queue.copy(), battery, lost)

    def copy(self) -> Self:
        """A copy of the sensors, to be served independently."""
        return replace(self, queue=self.queue.copy(), battery=self.battery.copy(), lost=self.lost.copy())

    def arrive(self, step: int, capacity: int) -> IntArray:
        """Let a step's packets arrive, and return those lost, ``(..., J)``."""
        self.queue[...], lost = arrive(self.queue, self.arrivals[..., step, :], capacity)
        self.lost[...] += lost
        return np.asarray(lost)

    def of(self, world: int) -> Self:
        """The sensors of one of the worlds, in the same memory."""
        return type(self)(*(getattr(self, field.name)[world] for field in fields(self)))


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

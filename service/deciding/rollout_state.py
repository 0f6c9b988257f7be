"""The rollout evaluator's initial state, a copy of the belief before a UAV's decision, and futures sampled from it."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared.belief.arrivals import Arrivals
from shared.belief.fleet_belief import FleetBelief
from shared.planning.orders import NO_GUIDANCE, Guidance
from shared.world.channel import FloatArray
from shared.world.scenario import Scenario
from shared.world.step_rule import Action

# Steps. Losses after the horizon do not count, because the positions where look-ahead leaves the UAVs are arbitrary.
_HORIZON = 8
_MAX_SENSORS = 64
_MAX_UAVS = 10


@dataclass(frozen=True, slots=True)
class RolloutState:
    """A copy of the belief for the evaluation of one UAV's candidates, so that another thread may evaluate.

    Attributes:
        sensors: shape ``(n,)``, IDs of the simulated sensors: those in reach of a UAV within the horizon.
        queue: shape ``(n,)``, the last known packets.
        unknown: shape ``(n,)``, whether the queue is unknown and is sampled as the world samples it.
        age: shape ``(n,)``, steps since the queue was known.
        burst_before: shape ``(n,)``, packets above the rate that are expected to have come since then.
        arrived, watched: shape ``(n,)``, shape and rate of the Gamma belief of the packets a step.
        dispersion: the variance of the packets of a step over a Poisson's.
        bursts: shape ``(horizon, n)``, packets above the rate that are expected in each step.
        links: by UAV, shape ``(horizon x max_velocity + 1, n)``: the packets that the UAV can move over a working link,
            by the sum of its velocities so far.
        margins: by UAV, of the same shape: the link's path loss below the threshold, in standard deviations of its
            uncertainty; empty if the links are certain.
        holds: by UAV, of the same shape: the probability that the link works; empty if the links are certain.
        alive: shape ``(n,)``, the probability that each sensor's radio works.
        decided: the velocities of the UAVs that already have a decision in this step.
        reserved: shape ``(n,)``, sensors that other UAVs have in this step.
        plans: by UAV, shape ``(steps, 2)``: planned sensors, as indices into ``sensors`` (-1: none), and velocities.
        guidance: the confirmed guidance.
        visited: shape ``(J,)``, the step of each sensor's last visit.
    """

    scenario: Scenario
    uav: int
    horizon: int
    seed: tuple[int, int, int]
    sensors: NDArray[np.int64]
    queue: FloatArray
    unknown: NDArray[np.bool_]
    age: NDArray[np.int64]
    burst_before: FloatArray
    arrived: FloatArray
    watched: FloatArray
    dispersion: float
    bursts: FloatArray
    links: dict[int, FloatArray]
    margins: dict[int, FloatArray]
    holds: dict[int, FloatArray]
    alive: FloatArray
    decided: dict[int, int]
    reserved: NDArray[np.bool_]
    plans: dict[int, NDArray[np.int64]]
    guidance: Guidance
    step: int
    visited: NDArray[np.int64]

    @property
    def rates(self) -> FloatArray:
        """Packets a step that are expected, ``(n,)``."""
        return self.arrived / self.watched

    @classmethod
    def of(
        cls,
        belief: FleetBelief,
        scenario: Scenario,
        step: int,
        uav: int,
        *,
        seed: int = 0,
        reserved: Collection[int] = (),
        plans: Mapping[int, NDArray[np.int64] | Sequence[Action]] | None = None,
        guidance: Guidance = NO_GUIDANCE,
    ) -> "RolloutState":
        """The state before this UAV's decision at this step; ``plans`` are the fleet's from this step on."""
        # A fleet may continue past the scenario's last step.
        left = scenario.steps - step
        horizon = min(_HORIZON, left) if left > 0 else _HORIZON
        # Any subset of UAVs serves: their distances change within the horizon.
        others = [other for other in belief.present(step) if other != uav][: _MAX_UAVS - 1]
        flown = np.arange(horizon * scenario.max_velocity + 1) * scenario.step_s
        expected = {i: belief.links(i, flown) for i in (uav, *others)}
        links = {i: found.packets.astype(np.float64) for i, found in expected.items()}
        margins = {i: found.margin for i, found in expected.items() if found.margin is not None}
        sensors = _most_urgent(belief, scenario, step, guidance, links.values())
        decided = belief.decided(step)
        flying = [(decided[other], expected[other].likely) for other in set(decided) & set(others)]
        moved = [(sensor, int(likely[velocity, sensor])) for (sensor, velocity), likely in flying]
        queue, age, unknown, visited = _after(belief, step, moved)
        burst = belief.arrivals.burst(step)[sensors] * Arrivals.burst_over(np.arange(horizon + 1)[:, None])
        return cls(
            scenario=scenario,
            uav=uav,
            horizon=horizon,
            seed=(seed, step, uav),
            sensors=sensors,
            queue=queue[sensors],
            unknown=unknown[sensors],
            age=age[sensors],
            burst_before=belief.arrivals.since(step - age[sensors], step, sensors)
            - belief.arrivals.rate[sensors] * age[sensors],
            arrived=belief.arrivals.arrived[sensors],
            watched=belief.arrivals.watched[sensors],
            dispersion=belief.arrivals.dispersion,
            bursts=np.diff(burst, axis=0),
            links={i: table[:, sensors] for i, table in links.items()},
            margins={i: table[:, sensors] for i, table in margins.items()},
            holds={i: expected[i].hold[:, sensors] for i in margins},
            alive=belief.channel.failures.alive(sensors),
            decided={i: decided[i][1] for i in others if i in decided},
            reserved=np.isin(sensors, list(reserved)),
            plans={i: _indexed(sensors, actions[:horizon]) for i, actions in (plans or {}).items() if i in links},
            guidance=guidance,
            step=step,
            visited=visited,
        )


def _after(
    belief: FleetBelief, step: int, moved: Sequence[tuple[int, int]]
) -> tuple[FloatArray, NDArray[np.int64], NDArray[np.bool_], NDArray[np.int64]]:
    """Queues, ages, whether unknown, last visits, ``(J,)``, after others ``moved`` (sensor, packets) in this step."""
    # Nothing can be collected from a sensor with a flat battery, so its losses do not distinguish candidates.
    queue = np.where(belief.battery > 0, belief.base, 0.0)
    age = np.maximum(step - belief.since, 0)
    unknown = (belief.base_variance > 0) & (belief.battery > 0)
    visited = belief.visited.copy()
    for sensor, link in moved:
        queue[sensor] = max(0.0, float(belief.queue(step)[sensor] - link))
        age[sensor] = 0
        if link > 0:
            visited[sensor], unknown[sensor] = step, False
    return queue, age, unknown, visited


def _most_urgent(
    belief: FleetBelief, scenario: Scenario, step: int, guidance: Guidance, links: Iterable[FloatArray]
) -> NDArray[np.int64]:
    """The sensors in reach by these links that overflow soonest, after those with a visit interval in the guidance."""
    reached = np.flatnonzero(np.any([(table > 0).any(axis=0) for table in links], axis=0))
    room = (scenario.queue_capacity - belief.queue(step)) / np.maximum(belief.arrivals.rate, 1e-9)
    room = np.where(np.isfinite(guidance.visit_intervals(scenario.sensors)), -np.inf, room)
    return np.sort(reached[np.argsort(room[reached], kind="stable")[:_MAX_SENSORS]])


def _indexed(sensors: NDArray[np.int64], actions: NDArray[np.int64] | Sequence[Action]) -> NDArray[np.int64]:
    """A plan's actions with indices into ``sensors`` in place of IDs, ``(steps, 2)``."""
    index = {int(sensor): row for row, sensor in enumerate(sensors)}
    return np.array([(index.get(j, -1), v) for j, v in actions], dtype=np.int64).reshape(-1, 2)


@dataclass(frozen=True, slots=True)
class SampledFutures:
    """M futures sampled from the belief: queues ``(M, n)``, arrivals ``(H, M, n)``, and the sensors' fades ``(M, n)``.

    A fade is the excess of a sensor's path losses over their means, in standard deviations, the same in all steps:
    infinite where the radio is dead.
    """

    start: FloatArray
    arrivals: FloatArray
    fades: FloatArray

    @classmethod
    def of(cls, state: RolloutState, count: int) -> "SampledFutures":
        """Sample futures, each with its own arrival rates, because a rarely heard sensor may fill fast."""
        scenario, shape = state.scenario, (count, len(state.sensors))
        random = np.random.default_rng(state.seed)
        capacity = float(scenario.queue_capacity)
        rates = random.gamma(state.arrived, 1.0 / state.watched, shape)
        fewest, most = scenario.initial_queue_min * capacity, scenario.initial_queue_max * capacity
        drawn = random.uniform(fewest, most, shape)
        start = np.where(state.unknown, drawn, state.queue) + random.poisson(rates * state.age + state.burst_before)
        expected = rates
        if state.dispersion > 1.0:
            # A Poisson number of a Gamma mean has a variance above its mean.
            spread = state.dispersion - 1.0
            expected = random.gamma(np.maximum(rates + state.bursts[:, None], 1e-9) / spread, spread)
        arrivals = random.poisson(expected, (state.horizon, *shape)).astype(np.float64)
        fades = np.where(random.uniform(size=shape) < state.alive, random.standard_normal(shape), np.inf)
        return cls(np.minimum(start, capacity), arrivals, fades)

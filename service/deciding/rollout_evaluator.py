"""The rollout evaluator: the packets that the fleet is expected to lose after a candidate, simulated from the belief.

It evaluates all advisers, so it must not be short-sighted: one step of look-ahead underrates an adviser that plans
further ahead. The method is a rollout (Tesauro and Galperin 1996; Bertsekas, Tsitsiklis and Wu 1997): fly the
candidate, let every UAV follow the LLM-free policy for some steps, and count the lost packets. Where there is a plan,
the candidate is also flown with the rest of the plan after its first step, and the lower loss counts. That makes it a
parallel rollout (Chang, Givan and Chong 2004). The plan's own action is evaluated with the plan's own continuation, as
in a fortified rollout (Bertsekas 2020, Rollout, Policy Iteration, and Distributed Reinforcement Learning). In the
model, which is the edge's belief, the best candidate is therefore expected to lose no more than the plan.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from service.deciding.rollout_state import RolloutState, SampledFutures
from shared.belief.fleet_belief import FleetBelief
from shared.kit.compiled import compiled, inlined
from shared.planning.annealing_arrays import listed
from shared.planning.orders import LATE_PACKETS
from shared.world.channel import FloatArray
from shared.world.scenario import SCENARIOS
from shared.world.step_rule import Action
from shared.world.urgency import VELOCITY_BONUS, urgency_by_level

# Sampled futures. All candidates are flown through the same ones, so that arrivals cause no difference between them.
FUTURES = 48
# Choices that one evaluation weighs at most; larger worlds get fewer futures.
_MAX_ENTRIES = 20_000_000


class FlownWorld(NamedTuple):
    """A rollout's start as arrays: U UAVs, n sensors, V velocities, C sums of a UAV's velocities so far.

    Attributes:
        packets: shape ``(U, n, C)``, that a transfer can move over a link that holds.
        margins: of the same shape, the links' margins, as :class:`RolloutState` has them; C = 0: every link holds.
        holds: the same for the probabilities that the links hold.
        offered: shape ``(U, n or fewer)``, what look-ahead chooses from: the sensors that the UAV may reach within the
            horizon and one that it may not, if there is one; then -1.
        urgency: shape ``(W + 1, n)``, by the packets in the queue, weighted by the guidance.
        bonus: shape ``(V,)``, the worth of each velocity; minus infinity for a forbidden one.
        highest_bonus: shape ``()``.
        weights: shape ``(n,)``, factors of the packets lost.
        every: shape ``(n,)``, steps within which each sensor is to be visited; infinite without an order.
        late: shape ``()``, what each step costs in which a sensor is overdue, packets: an argument, because a compiled
            function that is kept would not see a change of the constant.
        waited: shape ``(n,)``, steps since the last visit.
        reserved: shape ``(n,)``, the sensors that other UAVs have in this step.
        decided: shape ``(U,)``, each UAV's velocity in this step, -1 where it has no decision yet.
    """

    packets: FloatArray
    margins: FloatArray
    holds: FloatArray
    offered: NDArray[np.int64]
    urgency: FloatArray
    bonus: FloatArray
    highest_bonus: FloatArray
    weights: FloatArray
    every: FloatArray
    late: FloatArray
    waited: NDArray[np.int64]
    reserved: NDArray[np.bool_]
    decided: NDArray[np.int64]

    @classmethod
    def of(cls, state: RolloutState) -> Self:
        """The arrays of a state with at least one sensor."""
        scenario, guidance, uavs = state.scenario, state.guidance, list(state.links)
        fast = np.arange(scenario.max_velocity + 1, dtype=np.float64)
        weights = guidance.weights(scenario.sensors)[state.sensors]
        packets, margins, holds = (_stacked(tables) for tables in (state.links, state.margins, state.holds))
        bonus = np.where(guidance.allowed(len(fast)), VELOCITY_BONUS * fast, -np.inf)
        return cls(
            packets=packets,
            margins=margins,
            holds=holds,
            offered=_offered(packets),
            urgency=np.ascontiguousarray(urgency_by_level(state.rates, scenario) * weights),
            bonus=bonus,
            highest_bonus=np.asarray(bonus.max()),
            weights=weights,
            every=guidance.visit_intervals(scenario.sensors)[state.sensors],
            late=np.asarray(LATE_PACKETS),
            waited=state.step - state.visited[state.sensors],
            reserved=state.reserved,
            decided=np.array([state.decided.get(uav, -1) for uav in uavs]),
        )


def _stacked(tables: dict[int, FloatArray]) -> FloatArray:
    """Every UAV's table ``(C, n)``, ``(U, n, C)``."""
    if not tables:
        return np.zeros((0, 0, 0))
    return np.ascontiguousarray(np.stack(list(tables.values())).transpose(0, 2, 1))


def _offered(packets: FloatArray) -> NDArray[np.int64]:
    near = np.asarray((packets > 0).any(axis=2))
    # All sensors out of reach are alike, and of equal ones the first is chosen.
    near[np.arange(len(near)), (~near).argmax(axis=1)] = True
    return listed(near)


class _Flight(NamedTuple):
    """One flight's state.

    ``queue``, packets, ``served`` in this step, ``in_reach`` of the candidate and ``waited``, steps, have shape
    ``(n,)``; ``flown``, the sums of the UAVs' velocities, ``(U,)``.
    """

    queue: FloatArray
    served: NDArray[np.bool_]
    in_reach: NDArray[np.bool_]
    waited: NDArray[np.int64]
    flown: NDArray[np.int64]


def fly_candidates(
    world: FlownWorld, futures: SampledFutures, own: int, first: NDArray[np.int64], plans: dict[int, NDArray[np.int64]]
) -> tuple[FloatArray, FloatArray]:
    """Fly each of K candidates through each of M futures.

    Nothing checks that the velocities of candidates, plans and decisions are at most V - 1.

    Args:
        own: the place in the world's arrays of the UAV whose candidates they are.
        first: shape ``(K, 2)``, the candidates: a sensor, -1 for one that no UAV can reach, and a velocity.
        plans: by the UAV's place in the world's arrays, shape ``(steps, 2)``: its next steps from this one on, after
            which it follows look-ahead. The candidate takes the place of its UAV's first step.

    Returns:
        The packets lost, and the cost of the candidate's step, ``(K, M)`` each.
    """
    uavs, sensors, _ = world.packets.shape
    steps, many, _ = futures.arrivals.shape
    planned = np.full((uavs, steps, 2), -1)
    for uav, actions in plans.items():
        planned[uav, : len(actions)] = actions
    flight = _Flight(
        queue=np.zeros(sensors),
        served=np.zeros(sensors, dtype=np.bool_),
        in_reach=np.zeros(sensors, dtype=np.bool_),
        waited=np.zeros(sensors, dtype=np.int64),
        flown=np.zeros(uavs, dtype=np.int64),
    )
    lost, cost = np.zeros((len(first), many)), np.zeros((len(first), many))
    _fly_all(world, futures.start, futures.arrivals, futures.fades, own, first, planned, flight, lost, cost)
    return lost, cost


@compiled
def _fly_all(
    world: FlownWorld,
    start: FloatArray,
    arrivals: FloatArray,
    fades: FloatArray,
    own: int,
    first: NDArray[np.int64],
    planned: NDArray[np.int64],
    flight: _Flight,
    lost: FloatArray,
    cost: FloatArray,
) -> None:
    """Fly every candidate through every future; see :func:`fly_candidates`."""
    for candidate in range(first.shape[0]):
        for future in range(start.shape[0]):
            for j in range(start.shape[1]):
                flight.queue[j] = start[future, j]
                flight.served[j] = world.reserved[j]
                flight.waited[j] = world.waited[j]
            for uav in range(flight.flown.shape[0]):
                flight.flown[uav] = 0
            cost[candidate, future] = _fly_candidate(
                world, fades, flight, future, own, first[candidate, 0], first[candidate, 1]
            )
            for step in range(arrivals.shape[0]):
                for uav in range(flight.flown.shape[0]):
                    if step > 0 or uav != own:
                        _continue(world, fades, planned, flight, future, step, uav)
                over, in_reach = _arrive(world, flight, arrivals, step, future)
                lost[candidate, future] += over
                if step == 0:
                    cost[candidate, future] += in_reach / (world.urgency.shape[0] - 1.0)


@inlined
def _fly_candidate(
    world: FlownWorld, fades: FloatArray, flight: _Flight, future: int, own: int, sensor: int, velocity: int
) -> float:
    """Fly the candidate; returns f: 1 where its transmission fails, else 0."""
    for j in range(flight.queue.shape[0]):
        flight.in_reach[j] = _link(world, fades, flight, future, own, j, velocity) > 0.0
    failed = 1.0
    if sensor >= 0 and _serve(flight, sensor, _link(world, fades, flight, future, own, sensor, velocity)):
        failed = 0.0
    flight.flown[own] += velocity
    return failed


@inlined
def _continue(
    world: FlownWorld, fades: FloatArray, planned: NDArray[np.int64], flight: _Flight, future: int, step: int, uav: int
) -> None:
    """Fly a UAV's step: its decision, the plan's step, or look-ahead's where the plan is shorter."""
    sensor, velocity = -1, 0
    if step == 0 and world.decided[uav] >= 0:
        # The state's queues are already without the packets of this decision.
        velocity = world.decided[uav]
    elif planned[uav, step, 1] >= 0:
        sensor, velocity = planned[uav, step, 0], planned[uav, step, 1]
    else:
        sensor, velocity = _look_ahead(world, flight, uav)
    if sensor >= 0:
        _serve(flight, sensor, _link(world, fades, flight, future, uav, sensor, velocity))
    flight.flown[uav] += velocity


@inlined
def _look_ahead(world: FlownWorld, flight: _Flight, uav: int) -> tuple[int, int]:
    """One step of look-ahead, as in :func:`service.deciding.advisers.look_ahead`; of equal choices the first."""
    best, best_sensor, best_velocity = -math.inf, world.offered[uav, 0], 0
    for place in range(world.offered.shape[1]):
        j = world.offered[uav, place]
        if j < 0:
            break
        urgent = world.urgency[int(flight.queue[j]), j]
        queue = 0.0 if flight.served[j] else flight.queue[j]
        # No velocity moves more packets than wait, or is worth more than the best one.
        if queue * urgent + world.highest_bonus[()] <= best:
            continue
        for velocity in range(world.bonus.shape[0]):
            at = flight.flown[uav] + velocity
            moved = min(world.packets[uav, j, at], queue)
            if world.holds.shape[2] > 0:
                moved *= world.holds[uav, j, at]
            worth = moved * urgent + world.bonus[velocity]
            if worth > best:
                best, best_sensor, best_velocity = worth, j, velocity
    return best_sensor, best_velocity


@inlined
def _link(
    world: FlownWorld, fades: FloatArray, flight: _Flight, future: int, uav: int, sensor: int, velocity: int
) -> float:
    """Packets that one more step at a velocity can move from a sensor; 0 where the link fails."""
    at = flight.flown[uav] + velocity
    if world.margins.shape[2] > 0 and not world.margins[uav, sensor, at] > fades[future, sensor]:
        return 0.0
    return float(world.packets[uav, sensor, at])


@inlined
def _serve(flight: _Flight, sensor: int, packets: float) -> bool:
    """Move packets from a sensor over a link with this capacity; returns whether that succeeds."""
    holds = packets > 0.0 and not flight.served[sensor]
    if holds:
        flight.queue[sensor] -= min(flight.queue[sensor], packets)
        flight.served[sensor] = True
        flight.waited[sensor] = 0
    return holds


@inlined
def _arrive(world: FlownWorld, flight: _Flight, arrivals: FloatArray, step: int, future: int) -> tuple[float, float]:
    """End the step with its arrivals; returns the weighted loss, and the packets lost in the candidate's reach."""
    capacity, lost, in_reach = world.urgency.shape[0] - 1.0, 0.0, 0.0
    for j in range(flight.queue.shape[0]):
        filled = flight.queue[j] + arrivals[step, future, j]
        flight.queue[j] = min(filled, capacity)
        over = filled - flight.queue[j]
        lost += over * world.weights[j]
        if flight.in_reach[j]:
            in_reach += over
        if flight.waited[j] >= world.every[j]:
            lost += world.late[()]
        flight.waited[j] += 1
        flight.served[j] = False
    return lost, in_reach


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Expectations for C candidates, ``(C,)`` each.

    ``lost``: packets that the fleet loses over the horizon. ``cost``: the cost of the step as the UAV will report it,
    ``f + lost / W`` of the sensors in its reach.
    """

    lost: FloatArray
    cost: FloatArray


def evaluate(state: RolloutState, candidates: Sequence[Action]) -> Evaluation:
    """Fly every candidate through the same sampled futures; takes a few milliseconds."""
    scenario, sensors, count = state.scenario, len(state.sensors), len(candidates)
    if not sensors:
        return Evaluation(np.zeros(count), np.ones(count))
    uavs = list(state.links)
    plans = {uavs.index(uav): actions for uav, actions in state.plans.items()}
    continuations = [{}, plans] if plans else [{}]
    entries = count * sensors * (scenario.max_velocity + 1) * len(uavs) * state.horizon * len(continuations)
    futures = SampledFutures.of(state, int(np.clip(_MAX_ENTRIES // entries, 1, FUTURES)))
    world = FlownWorld.of(state)
    index = {int(sensor): row for row, sensor in enumerate(state.sensors)}
    # A sensor that is not simulated is out of every UAV's reach.
    first = np.array([(index.get(sensor, -1), velocity) for sensor, velocity in candidates])
    flown = [fly_candidates(world, futures, uavs.index(state.uav), first, plans) for plans in continuations]
    return Evaluation(np.min([lost.mean(axis=1) for lost, _ in flown], axis=0), flown[-1][1].mean(axis=1))


def warm_up() -> None:
    """Compile the flights, or load what an earlier process has compiled, in advance."""
    scenario = SCENARIOS["paper"]
    belief = FleetBelief(scenario)
    x, y = (float(metres) for metres in belief.trajectory(0).at(0.0))
    belief.locate(0, 0, (x, y), 0.0)
    belief.places[0] = x, y
    evaluate(RolloutState.of(belief, scenario, 0, 0), [Action(0, 0)])

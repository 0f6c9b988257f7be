"""The rule of a step, against a plain loop over the UAVs, and every other form of it against the rule."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from service.deciding.rollout_evaluator import FlownWorld, fly_candidates
from service.deciding.rollout_state import SampledFutures
from shared.planning.annealing import Annealing
from shared.planning.fleet_problem import FleetProblem, fly
from shared.planning.queue_chains import QueueChains
from shared.world.channel import FloatArray, IntArray
from shared.world.scenario import SCENARIOS, Scenario
from shared.world.step_rule import arrive, joules_a_packet, transfer
from shared.world.trajectory import trajectories
from simulator.bound.formulation import Formulation
from simulator.world.batch import Draw, VectorWorld, stacked

FASTEST = 2
SEEDS = st.integers(0, 2**32 - 1)


@dataclass(frozen=True, eq=False)
class ByHand:
    """One step of one world, the UAVs one after the other."""

    served: list[bool]
    moved: list[int]
    queue: list[int]
    battery: list[float]
    lost: list[int]

    @classmethod
    def of(
        cls,
        queue: IntArray,
        battery: FloatArray,
        transfers: Iterable[NDArray[Any]],
        arrived: IntArray,
        capacity: int,
    ) -> ByHand:
        queues, batteries = queue.tolist(), battery.tolist()
        busy: set[int] = set()
        served, moved = [], []
        for j, held, most, joule in zip(*(part.tolist() for part in transfers), strict=True):
            affordable = math.floor(batteries[j] / joule + 1e-9)
            able = held and j not in busy and affordable >= 1
            taken = min(queues[j], most, affordable) if able else 0
            if able:
                busy.add(j)
                queues[j] -= taken
                batteries[j] = max(0.0, batteries[j] - taken * joule)
            served.append(able)
            moved.append(taken)
        filled = [q + a for q, a in zip(queues, arrived.tolist(), strict=True)]
        lost = [max(0, q - capacity) for q in filled]
        return cls(served, moved, [min(q, capacity) for q in filled], batteries, lost)


def rule(
    queue: IntArray, battery: FloatArray, transfers: tuple[Any, Any, Any, Any], arrived: IntArray, capacity: int
) -> ByHand:
    """The same step by the rule."""
    served, moved = transfer(queue, battery, *transfers)
    queue, lost = arrive(queue, arrived, capacity)
    return ByHand(*(array.tolist() for array in (served, moved, queue, battery, lost)))


@given(SEEDS, st.integers(1, 4), st.integers(1, 6), st.integers(1, 3))
def test_all_worlds_step_as_each_does_by_hand(seed: int, sensors: int, uavs: int, worlds: int) -> None:
    random = np.random.default_rng(seed)
    capacity = int(random.integers(1, 40))
    queue = random.integers(0, capacity, (worlds, sensors), endpoint=True)
    battery = random.choice([0.0, 0.3, 1.0, 2.5, 50.0], (worlds, sensors))
    transfers = (
        random.integers(sensors, size=(worlds, uavs)),
        random.random((worlds, uavs)) < 0.7,
        random.integers(0, 60, (worlds, uavs)),
        # Of 0.1 the float is above the tenth: the last packet of a battery needs the margin.
        random.choice([0.1, 0.25, 0.7, np.inf], (worlds, uavs)),
    )
    arrived = random.integers(0, 30, (worlds, sensors))
    alone = [
        ByHand.of(queue[b], battery[b], [part[b] for part in transfers], arrived[b], capacity) for b in range(worlds)
    ]
    together = rule(queue, battery, transfers, arrived, capacity)
    for name in ("served", "moved", "queue", "battery", "lost"):
        assert getattr(together, name) == [getattr(one, name) for one in alone], name


@settings(max_examples=30, deadline=None)
@given(SEEDS, st.sampled_from(["paper", "stress", "faulty", "shadowed"]), st.sampled_from([50.0, 0.5]))
def test_a_batch_of_worlds_steps_by_the_rule(seed: int, name: str, battery_j: float) -> None:
    scenario = SCENARIOS[name].model_copy(update={"battery_j": battery_j, "steps": 6, "sensors": 5})
    random, world = np.random.default_rng(seed), VectorWorld(scenario)
    draw = stacked([Draw.one(scenario, np.random.SeedSequence(one)) for one in (seed % 1000, 1)])
    world.start(draw)
    for step in range(scenario.steps):
        chosen, velocity = random.integers(scenario.sensors, size=(2, 3)), random.integers(15, size=(2, 3))
        ground, present = world.sensors.copy(), draw.truth.faults.present(step)
        _, outcome = world.fly(chosen, velocity)
        places = world.fleet.positions[:, :, None] - ground.positions[:, None]
        links = draw.truth.channel.links(
            np.hypot(places[..., 0], places[..., 1]), world.fleet.positions, world.fleet.progress_m, step + 1
        )
        named = links[np.arange(2)[:, None], np.arange(3), chosen]
        joules = joules_a_packet(named.rate_bps, scenario)
        for b in range(2):
            transfers = [part[b] for part in (chosen, named.hold & present, named.packets, joules)]
            arrived = ground.arrivals[b, step]
            found = ByHand.of(ground.queue[b], ground.battery[b], transfers, arrived, scenario.queue_capacity)
            assert world.sensors.queue[b].tolist() == found.queue
            assert world.sensors.battery[b].tolist() == found.battery
            assert outcome.moved[b].tolist() == found.moved
            assert (outcome.failed[b] == 0).tolist() == [
                s or not p for s, p in zip(found.served, present[b], strict=True)
            ]
            assert (outcome.lost_packets[b], outcome.overflows[b]) == (sum(found.lost), np.count_nonzero(found.lost))


def drawn_problem(seed: int, sensors: int, uavs: int, steps: int, **changes: Any) -> FleetProblem:
    """Short queues that fill fast, and links of which many fail."""
    random = np.random.default_rng(seed)
    world = Scenario(
        name="drawn", sensors=sensors, uavs=uavs, steps=steps, max_velocity=FASTEST, queue_capacity=30, step_s=1.0
    )
    packets = random.integers(-20, 40, (uavs, 1, steps * FASTEST + 1, sensors)).clip(min=0)
    return FleetProblem(
        **{
            "scenario": world,
            "trajectories": trajectories(world),
            "progress_m": np.zeros(uavs),
            "places": random.uniform(0, 1000, (sensors, 2)),
            "queue": random.integers(0, 31, sensors),
            "battery": np.full(sensors, 1e9),
            "arrivals": random.integers(0, 25, (steps, sensors)),
            "links": list(packets),
            **changes,
        }
    )


def drawn_actions(problem: FleetProblem, seed: int) -> IntArray:
    random, shape = np.random.default_rng(seed), (problem.horizon, problem.uavs)
    return np.stack((random.integers(problem.sensors, size=shape), random.integers(FASTEST + 1, size=shape)), axis=-1)


SIZES = (SEEDS, st.integers(1, 4), st.integers(1, 3), st.integers(1, 4))


@given(*SIZES, st.sampled_from([1e9, 2.0, 0.1]))
def test_a_plan_is_flown_by_the_rule(seed: int, sensors: int, uavs: int, steps: int, battery: float) -> None:
    problem = drawn_problem(seed, sensors, uavs, steps, battery=np.full(sensors, battery))
    actions, charge = drawn_actions(problem, seed), problem.battery
    course, flown = fly(problem, actions), actions[:, :, 1].cumsum(axis=0)
    assert problem.links is not None
    for step, sensor in enumerate(actions[:, :, 0]):
        packets = np.array([table[0, flown[step, uav], sensor[uav]] for uav, table in enumerate(problem.links)])
        joules = problem.scenario.transmit_power_w * problem.scenario.step_s / np.maximum(packets, 1)
        transfers = sensor, packets > 0, packets, joules
        found = ByHand.of(course.queue[step], charge, transfers, problem.arrivals[step], 30)
        assert course.queue[step + 1].tolist() == found.queue
        assert course.lost[step].tolist() == found.lost
        assert course.link[step].tolist() == [
            p if s else 0 for p, s in zip(packets.tolist(), found.served, strict=True)
        ]
        charge = np.array(found.battery)


@settings(max_examples=40, deadline=None)
@given(*SIZES)
def test_the_compiled_flights_follow_the_rule(seed: int, sensors: int, uavs: int, steps: int) -> None:
    problem = drawn_problem(seed, sensors, uavs, steps)
    actions = drawn_actions(problem, seed)
    course = fly(problem, actions)
    assert problem.links is not None
    # Contiguous, as an edge's are: another layout would be compiled anew, for seconds.
    whole = np.ascontiguousarray([table[0].T for table in problem.links], dtype=np.float64)
    nothing = np.zeros((0, 0, 0))
    world = FlownWorld(
        packets=whole,
        margins=nothing,
        holds=nothing,
        offered=np.full((uavs, 1), -1),
        urgency=np.zeros((31, sensors)),
        bonus=np.zeros(FASTEST + 1),
        highest_bonus=np.asarray(0.0),
        weights=np.ones(sensors),
        every=np.full(sensors, np.inf),
        late=np.asarray(0.0),
        waited=np.zeros(sensors, dtype=np.int64),
        reserved=np.zeros(sensors, dtype=np.bool_),
        decided=np.full(uavs, -1),
    )
    arrivals = problem.arrivals[:, None].astype(np.float64)
    futures = SampledFutures(problem.queue[None].astype(np.float64), arrivals, np.zeros((1, sensors)))
    # The candidate's UAV flies first: it is UAV 0 that the others follow.
    plans = {uav: actions[:, uav] for uav in range(uavs)}
    lost, cost = fly_candidates(world, futures, 0, actions[:1, 0], plans)
    assert lost.item() == course.lost.sum()
    in_reach = whole[0, :, actions[0, 0, 1]] > 0
    assert cost.item() == (course.link[0, 0] == 0) + course.lost[0, in_reach].sum() / 30


@settings(max_examples=25, deadline=None)
@given(*SIZES)
def test_the_constraints_of_the_bound_lose_what_the_rule_loses(seed: int, sensors: int, uavs: int, steps: int) -> None:
    from ortools.sat.python import cp_model

    problem = drawn_problem(seed, sensors, uavs, steps)
    actions = drawn_actions(problem, seed)
    course = fly(problem, actions)
    formulation = Formulation(problem)
    flown = actions[:, :, 1].cumsum(axis=0)
    for uav, row in enumerate(formulation.flown):
        for step, variable in enumerate(row):
            formulation.model.add(variable == int(flown[step, uav]))
    for serve, literal in formulation.serves.items():
        at = serve.step, serve.uav
        if actions[at][0] != serve.sensor or not course.link[at]:
            formulation.model.add(literal == 0)
    solver = cp_model.CpSolver()
    assert solver.solve(formulation.model) == cp_model.OPTIMAL
    # The solver scales the objective: its value is off by the last bits.
    assert abs(solver.objective_value - course.lost.sum()) < 1e-6


@settings(max_examples=40, deadline=None)
@given(*SIZES)
def test_certain_chains_lose_what_the_rule_loses(seed: int, sensors: int, uavs: int, steps: int) -> None:
    problem = drawn_problem(seed, sensors, uavs, steps)
    # The search's last sensor is nowhere.
    nowhere = [np.pad(table, ((0, 0), (0, 0), (0, 1))) for table in problem.links or ()]
    queue, arrivals = np.append(problem.queue, 0), np.pad(problem.arrivals, ((0, 0), (0, 1)))
    levels, one_hot = np.arange(31), np.eye(31, dtype=np.float32)
    chains = QueueChains(
        level=1.0,
        start=one_hot[queue],
        arrive=one_hot[arrivals],
        lost=arrive(levels, arrivals[..., None], 30)[1].astype(np.float32),
        after=np.zeros((1, sensors + 1, 31), dtype=np.float32),
    )
    whole = replace(
        problem,
        places=np.concatenate((problem.places, [[1e6, 1e6]])),
        queue=queue,
        battery=np.append(problem.battery, 0.0),
        arrivals=arrivals,
        links=nowhere,
        chains=chains,
    )
    actions = drawn_actions(problem, seed)
    course = fly(problem, actions)
    assert Annealing(whole).priced(actions).expected_loss == course.lost.sum()

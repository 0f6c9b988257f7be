"""No policy reads the hidden state: it decides from its UAVs' observations, and cannot reach anything else."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from types import BuiltinFunctionType, CodeType, FrameType, FunctionType, ModuleType
from typing import Any

import numpy as np
import pytest

from shared.world.scenario import SCENARIOS, Scenario
from simulator.flying.flight import rollout
from simulator.policies.registry import POLICY_NAMES, Policy, policy_named
from simulator.world.batch import Fleet, VectorWorld
from simulator.world.environment import PipelineWorld
from simulator.world.observation import Observation
from simulator.world.sensors import Sensors, Streams
from simulator.world.truth import Truth

# The paper's world with radios so weak that some sensors stay unheard for a while.
SCENARIO = SCENARIOS["paper"].model_copy(update={"radio_radius_m": 200.0})
NAMES = (*POLICY_NAMES, "lab.marl.learned:madqn", "lab.marl.learned:mappo")
DECISIONS, SEED = 4, 0
HIDDEN = (PipelineWorld, VectorWorld, Sensors, Streams, Fleet, Truth)
Actions = list[tuple[int, int]]

pytestmark = pytest.mark.usefixtures("brief")


def copied(observation: Observation) -> Observation:
    """The same values in new arrays."""
    copy: Any = {key: np.array(value) for key, value in observation.items()}
    return copy  # type: ignore[no-any-return]


def decide(policy: Policy, seen: list[Observation]) -> Actions:
    """One step's actions, each from a copy of the UAV's observation."""
    actions: Actions = []
    for uav, observation in enumerate(seen):
        taken = frozenset(sensor for sensor, _ in actions)
        sensor, velocity = policy.decide(uav, copied(observation), taken)
        actions.append((int(sensor), int(velocity)))
    return actions


class Flight:
    """The first steps of a mission: the observation and the action of each decision, and the world after them.

    ``unheard`` is, for every sensor, the step from which on nobody has heard it (0: never heard), shape ``(J,)``. If
    given, everything that nobody hears from those steps on is another: queues, batteries, arrivals and rates.
    """

    def __init__(self, policy: Policy, unheard: Any = None) -> None:
        self.world = PipelineWorld(SCENARIO)
        observations, _ = self.world.reset(seed=SEED)
        if unheard is not None:
            _change_what_is_hidden(self.world.sensors, unheard)
        policy.reset(SCENARIO, SEED)
        self.seen: list[list[Observation]] = []
        self.actions: list[Actions] = []
        for decision in range(DECISIONS):
            if decision:
                observations, *_ = self.world.step({f"uav_{i}": np.array(a) for i, a in enumerate(self.actions[-1])})
            self.seen.append([copied(observation) for observation in observations.values()])
            self.actions.append(decide(policy, self.seen[-1]))
        self.unheard = np.max([observation["last_heard"] for observation in self.seen[-1]], axis=0)


def _change_what_is_hidden(sensors: Sensors, unheard: Any) -> None:
    never = unheard < 0
    sensors.queue[:] = np.where(never, 60 - sensors.queue // 2, sensors.queue)
    sensors.battery[:] = np.where(never, 1.0, sensors.battery)
    sensors.rates[:] = sensors.rates[::-1].copy()
    # The arrivals of a step are in the queue heard after it.
    later = np.arange(SCENARIO.steps)[:, None] >= np.maximum(unheard, 0)
    sensors.arrivals[:] = np.where(later, sensors.arrivals + 7, sensors.arrivals)


@pytest.mark.parametrize("name", NAMES)
def test_hidden_differences_of_worlds_do_not_change_decisions(name: str) -> None:
    one = Flight(policy_named(name))
    two = Flight(policy_named(name), one.unheard)
    assert np.any(one.unheard < 0) and np.any((one.unheard >= 0) & (one.unheard < DECISIONS - 1))
    assert np.count_nonzero(one.world.sensors.queue != two.world.sensors.queue) >= 3
    assert np.all(one.world.sensors.arrivals[DECISIONS:] != two.world.sensors.arrivals[DECISIONS:])
    np.testing.assert_equal(two.seen, one.seen)
    assert two.actions == one.actions


@pytest.mark.parametrize("name", NAMES)
def test_observations_alone_lead_to_the_same_decisions(name: str) -> None:
    """The decisions repeated without a world, and without a way to draw one."""
    flight = Flight(policy_named(name))
    seen, actions = flight.seen, flight.actions
    del flight
    assert asked_again(policy_named(name), seen) == actions


def asked_again(policy: Policy, seen: list[list[Observation]]) -> list[Actions]:
    def forbidden(*_: object) -> None:
        raise AssertionError("a policy draws a world")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Sensors, "draw", forbidden)
        patch.setattr(Streams, "of", forbidden)
        policy.reset(SCENARIO, SEED)
        return [decide(policy, step) for step in seen]


@pytest.mark.parametrize("name", NAMES)
def test_nothing_hidden_is_within_a_policys_reach(name: str) -> None:
    policy = policy_named(name)
    rollout(PipelineWorld(SCENARIO.model_copy(update={"steps": 3})), policy, SEED)
    assert [type(found).__name__ for found in reachable(policy) if isinstance(found, HIDDEN)] == []


def reachable(root: object) -> Iterator[object]:
    """Every object reachable from one, with the closures and defaults of functions."""
    # References from these belong to the program, not to the policy.
    program = (type, ModuleType, CodeType, FrameType, BuiltinFunctionType)
    found, left = {id(root)}, [root]
    while left:
        at = left.pop()
        yield at
        if isinstance(at, FunctionType):
            referred: list[object] = [at.__closure__, at.__defaults__, at.__kwdefaults__]
        else:
            referred = gc.get_referents(at)
        if isinstance(at, np.ndarray):
            referred.append(at.base)
        fresh = [other for other in referred if id(other) not in found and not isinstance(other, program)]
        found.update(id(other) for other in fresh)
        left += fresh


def test_an_observation_is_a_copy_that_leads_nowhere() -> None:
    world = PipelineWorld()
    observations, _ = world.reset(seed=SEED)
    for _ in range(3):
        parts = (world._worlds, world.sensors, world.fleet)
        arrays = [value for part in parts for value in vars(part).values() if isinstance(value, np.ndarray)]
        assert len(arrays) > 8
        for observation in observations.values():
            for key, value in observation.items():
                assert isinstance(value, np.ndarray) and value.base is None, key
                assert not any(np.may_share_memory(value, array) for array in arrays), key
        observations, *_ = world.step({agent: np.array([0, 5]) for agent in world.agents})


class Vandal:
    """Flies EOF, and overwrites its observation."""

    def __init__(self) -> None:
        self._eof = policy_named("eof")

    def reset(self, scenario: Scenario, seed: int) -> None:
        self._eof.reset(scenario, seed)

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
        action = self._eof.decide(uav, observation, taken)
        values: Any = observation.values()
        for value in values:
            value[...] = -7
        return action


def test_changes_of_an_observation_do_not_change_the_world() -> None:
    vandalised, left_alone = (rollout(PipelineWorld(), policy, SEED) for policy in (Vandal(), policy_named("eof")))
    assert [(t.events, t.lost_packets) for t in vandalised] == [(t.events, t.lost_packets) for t in left_alone]


# ---- cheating policies, to show that the tests above detect them


class Cheat:
    """Takes the truly fullest sensor of a world to which it has a reference."""

    def reset(self, scenario: Scenario, seed: int) -> None:
        self.world = self.hold_of(scenario, seed)

    def hold_of(self, scenario: Scenario, seed: int) -> PipelineWorld:
        raise NotImplementedError

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
        return int(np.argmax(self.world.sensors.queue + 10 * self.world.sensors.rates)), 7


class Prying(Cheat):
    """Reads the variables of its caller's caller, which flies the world."""

    def hold_of(self, scenario: Scenario, seed: int) -> PipelineWorld:
        world: PipelineWorld = sys._getframe(2).f_locals["self"].world
        return world


class Drawing(Cheat):
    """Draws the world again from the seed."""

    def hold_of(self, scenario: Scenario, seed: int) -> PipelineWorld:
        world = PipelineWorld(scenario)
        world.reset(seed=seed)
        return world


def test_a_cheat_that_pries_would_be_noticed() -> None:
    one = Flight(Prying())
    assert Flight(Prying(), one.unheard).actions != one.actions


def test_a_cheat_that_draws_the_world_again_would_be_noticed() -> None:
    seen = Flight(Drawing()).seen
    with pytest.raises(AssertionError, match="a policy draws a world"):
        asked_again(Drawing(), seen)


def test_a_cheat_that_keeps_a_world_would_be_noticed() -> None:
    class Hiding:
        def __init__(self, world: PipelineWorld) -> None:
            self.look = lambda: [world]

    assert any(isinstance(found, PipelineWorld) for found in reachable(Hiding(PipelineWorld())))
    assert any(isinstance(found, np.ndarray) and found.size == 9 for found in reachable([np.arange(9.0)[:2]]))

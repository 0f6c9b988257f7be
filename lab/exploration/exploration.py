"""Training missions: UAVs explore a world, or fly an edge's decisions, with a teacher or without one."""

from __future__ import annotations

import secrets
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Protocol, Self

import numpy as np

from lab.exploration.rollouts import Reference, RolloutStep
from lab.training_seeds import FIRST_TRAINING_SEED
from shared.client.errors import EdgeError
from shared.world.scenario import Scenario

# The world and the planner take seconds to import; `--help` and usage errors do without them.
if TYPE_CHECKING:
    from lab.exploration.teachers import Action, Teacher, TeacherName
    from simulator.flying.pilots import PilotChoice
    from simulator.world.observation import Observation

# The longest deadline: a fallback of the edge teaches the LLM nothing.
_DEADLINE_MS = 60_000
_TIMEOUT_S = 65.0


def explore(
    scenario: Scenario,
    mission: int,
    teacher: TeacherName | None = None,
    edge: str | None = None,
    policy: str | None = None,
) -> Iterator[RolloutStep]:
    """One mission's decisions in order of step and UAV, in training world number ``mission``.

    Args:
        edge: URL of the edge whose decisions the UAVs fly; by default they explore.
        policy: the policy whose decisions they fly, in place of an edge's.

    Raises:
        EdgeError: the edge gives no decision.
        ModuleNotFoundError: there is a teacher and its planner is not installed: numba (extra ``planner``) or
            OR-Tools (extra ``experiments``).
    """
    from lab.exploration.teachers import TEACHERS
    from simulator.world.environment import PipelineWorld
    from simulator.world.observation import decide_request

    world = PipelineWorld(scenario)
    observations, _ = world.reset(seed=FIRST_TRAINING_SEED + mission)
    guide: Teacher | None = None if teacher is None else TEACHERS[teacher](world)
    with ExitStack() as stack:
        fleet: _Fleet
        if edge is not None:
            fleet = stack.enter_context(_EdgeFleet(edge, scenario, mission))
        elif policy is not None:
            fleet = _PolicyFleet(policy, scenario, mission)
        else:
            fleet = _ExploringFleet(scenario, mission, guide)
        for step in range(scenario.steps):
            fleet.begin_step()
            choices: dict[int, Action] = {}
            references: dict[int, Reference | None] = {}
            for agent, uav in world.live.items():
                observation, taken = observations[agent], frozenset(sensor for sensor, _ in choices.values())
                advised = None if guide is None else guide.refer(uav, observation, taken, fleet.deviating)
                choices[uav] = fleet.action(advised, uav, observation, taken)
                references[uav] = _reference(teacher, advised)
                if guide is not None:
                    guide.flown(uav, step, choices[uav])
            requests = {uav: decide_request(uav, observations[f"uav_{uav}"], f"train-{mission}") for uav in choices}
            observations, _, _, _, infos = world.step({f"uav_{u}": np.array(c) for u, c in choices.items()})
            for uav, (sensor, velocity) in choices.items():
                info = infos[f"uav_{uav}"]
                cost, failed = float(info["cost"]), bool(info["failed"])
                if guide is not None:
                    guide.learn(uav, step, failed)
                fleet.learn(uav, cost, failed)
                yield RolloutStep(
                    request=requests[uav],
                    sensor_id=sensor,
                    velocity=velocity,
                    cost=cost,
                    failed=failed,
                    fleet_lost=world.tally[-1].lost_packets,
                    reference=references[uav],
                )


def _reference(teacher: TeacherName | None, advised: Action | None) -> Reference | None:
    if teacher is None or advised is None:
        return None
    return Reference(teacher=teacher, sensor_id=advised[0], velocity=advised[1])


class _Fleet(Protocol):
    """Chooses the actions that are flown and recorded.

    Attributes:
        deviating: whether the fleet explores in this step, and so a clairvoyant has no reference in it.
    """

    deviating: bool

    def begin_step(self) -> None: ...

    def action(self, advised: Action | None, uav: int, observation: Observation, taken: frozenset[int]) -> Action: ...

    def learn(self, uav: int, cost: float, failed: bool) -> None: ...


class _ExploringFleet:
    """Flies the teacher's actions, and deviates in a share of steps drawn for the mission; 1 without a teacher."""

    def __init__(self, scenario: Scenario, mission: int, guide: Teacher | None) -> None:
        from simulator.policies.registry import policy_named

        self._rng = np.random.default_rng([FIRST_TRAINING_SEED, mission])
        self._share = 1.0 if guide is None else self._rng.uniform(0.0, guide.deviations)
        self._levels = scenario.max_velocity + 1
        self._policies = [policy_named("longest_queue"), policy_named("queue_and_channel")]
        for policy in self._policies:
            policy.reset(scenario, mission)
        self.deviating = False

    def begin_step(self) -> None:
        self.deviating = bool(self._rng.random() < self._share)

    def action(self, advised: Action | None, uav: int, observation: Observation, taken: frozenset[int]) -> Action:
        """The teacher's action, or a deviation from it.

        A deviation has a random velocity, and a sensor of `longest_queue`, of `queue_and_channel` or at random;
        sometimes one of the two is the teacher's.
        """
        if advised is not None and not self.deviating:
            return advised
        rng = self._rng
        sensor, _ = self._policies[rng.integers(2)].decide(uav, observation, taken)
        heard = np.flatnonzero(observation["last_heard"] >= 0)
        if rng.random() < 0.5 and len(heard):
            sensor = int(rng.choice(heard))
        velocity = int(rng.integers(self._levels))
        if advised is not None:
            followed = rng.integers(3)
            return (advised[0] if followed == 1 else sensor), (advised[1] if followed == 2 else velocity)
        return sensor, velocity

    def learn(self, uav: int, cost: float, failed: bool) -> None:
        """Nothing."""


class _PolicyFleet:
    """Flies a policy's decisions."""

    deviating = False

    def __init__(self, name: str, scenario: Scenario, mission: int) -> None:
        from simulator.policies.registry import policy_named

        self._policy = policy_named(name)
        self._policy.reset(scenario, mission)

    def begin_step(self) -> None:
        """Nothing."""

    def action(self, advised: Action | None, uav: int, observation: Observation, taken: frozenset[int]) -> Action:
        """The policy's decision."""
        return self._policy.decide(uav, observation, taken)

    def learn(self, uav: int, cost: float, failed: bool) -> None:
        """Nothing: the policies that learn are teachers."""


class _EdgeFleet:
    """Flies an edge's decisions in a mission of its own there, which ends with the flight; use as a context."""

    deviating = False

    def __init__(self, url: str, scenario: Scenario, mission: int) -> None:
        from shared.client.edge_client import EdgeClient
        from simulator.flying.pilots import EdgePilot

        self._client = EdgeClient(url, timeout_s=_TIMEOUT_S)
        self._mission_id = f"explore-{mission}-{secrets.token_hex(4)}"
        self._pilot = EdgePilot(self._client, self._mission_id, scenario, mission, deadline_ms=_DEADLINE_MS)
        # Planner and verifier would change the LLM's decisions, and so the states that they lead to.
        self._pilot.spec = self._pilot.spec.model_copy(update={"planner": "off", "verify": "off"})
        self._choices: dict[int, PilotChoice] = {}

    def __enter__(self) -> Self:
        self._client.put_mission(self._mission_id, self._pilot.spec)
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(EdgeError):
            self._client.delete_mission(self._mission_id)
        self._client.close()

    def begin_step(self) -> None:
        """Nothing."""

    def action(self, advised: Action | None, uav: int, observation: Observation, taken: frozenset[int]) -> Action:
        """The edge's decision."""
        choice = self._pilot.decide(uav, observation, taken)
        if choice.exchange is None:
            raise EdgeError(f"no decision: {self._pilot.last_error}")
        self._choices[uav] = choice
        return choice.sensor, choice.velocity

    def learn(self, uav: int, cost: float, failed: bool) -> None:
        """Keep the outcome for the UAV's next request."""
        self._pilot.learn(uav, self._choices[uav], cost, failed)

"""Training missions: exploring UAVs fly a world, beside a teacher or without one."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from shared.rollouts import Reference, RolloutStep
from shared.scenario import Scenario
from simulator.sites.training_seeds import FIRST_TRAINING_SEED

# The world and the planner take seconds to import; `--help` and usage errors do without them.
if TYPE_CHECKING:
    from simulator.flying.teachers import Action, Teacher, TeacherName
    from simulator.world import Observation


def explore(scenario: Scenario, mission: int, teacher: TeacherName | None = None) -> Iterator[RolloutStep]:
    """One mission's decisions in order of step and UAV, in training world number ``mission``.

    Raises:
        ModuleNotFoundError: there is a teacher and OR-Tools is not installed (extra ``planner``).
    """
    from simulator.client.observation_report import decide_request
    from simulator.flying.teachers import TEACHERS
    from simulator.world import PipelineWorld

    rng = np.random.default_rng([FIRST_TRAINING_SEED, mission])
    world = PipelineWorld(scenario)
    observations, _ = world.reset(seed=FIRST_TRAINING_SEED + mission)
    deviation = _Deviation(scenario, mission, rng)
    guide: Teacher | None = None if teacher is None else TEACHERS[teacher](world)
    share = 1.0 if guide is None else rng.uniform(0.0, guide.deviations)
    for step in range(scenario.steps):
        deviating = bool(rng.random() < share)
        choices: dict[int, Action] = {}
        references: dict[int, Reference | None] = {}
        for agent, uav in world.live.items():
            observation, taken = observations[agent], frozenset(sensor for sensor, _ in choices.values())
            advised = None if guide is None else guide.refer(uav, observation, taken, deviating)
            if advised is not None and not deviating:
                choices[uav] = advised
            else:
                choices[uav] = deviation.action(advised, uav, observation, taken)
            references[uav] = _reference(teacher, advised)
            if guide is not None:
                guide.flown(uav, step, choices[uav])
        requests = {uav: decide_request(uav, observations[f"uav_{uav}"], f"train-{mission}") for uav in choices}
        observations, _, _, _, infos = world.step({f"uav_{u}": np.array(c) for u, c in choices.items()})
        for uav, (sensor, velocity) in choices.items():
            info = infos[f"uav_{uav}"]
            if guide is not None:
                guide.learn(uav, step, bool(info["failed"]))
            yield RolloutStep(
                request=requests[uav],
                sensor_id=sensor,
                velocity=velocity,
                cost=float(info["cost"]),
                failed=bool(info["failed"]),
                fleet_lost=world.tally[-1].lost_packets,
                reference=references[uav],
            )


def _reference(teacher: TeacherName | None, advised: Action | None) -> Reference | None:
    if teacher is None or advised is None:
        return None
    return Reference(teacher=teacher, sensor_id=advised[0], velocity=advised[1])


class _Deviation:
    """The exploring actions of a fleet that deviates from its teacher or has none."""

    def __init__(self, scenario: Scenario, mission: int, rng: np.random.Generator) -> None:
        from simulator.policies.registry import policy_named

        self._rng = rng
        self._levels = scenario.max_velocity + 1
        self._guides = [policy_named("eof"), policy_named("wqcs")]
        for guide in self._guides:
            guide.reset(scenario, mission)

    def action(self, advised: Action | None, uav: int, observation: Observation, taken: frozenset[int]) -> Action:
        """A random velocity, and a sensor of EOF, of WQCS or at random; sometimes one of the two is the teacher's."""
        rng = self._rng
        sensor, _ = self._guides[rng.integers(2)].decide(uav, observation, taken)
        heard = np.flatnonzero(observation["last_heard"] >= 0)
        if rng.random() < 0.5 and len(heard):
            sensor = int(rng.choice(heard))
        velocity = int(rng.integers(self._levels))
        if advised is not None:
            followed = rng.integers(3)
            return (advised[0] if followed == 1 else sensor), (advised[1] if followed == 2 else velocity)
        return sensor, velocity

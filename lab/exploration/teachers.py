"""Teachers of the edge's modules: the planner, and a clairvoyant that knows every arrival beforehand."""

from __future__ import annotations

from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from simulator.bound.clairvoyant_bound import true_problem
from simulator.policies.mpc import RecedingHorizonPolicy
from simulator.world.environment import PipelineWorld
from simulator.world.observation import Observation

TeacherName = Literal["planner", "clairvoyant"]
Action = tuple[int, int]

# Deterministic seconds of search for the rest of a mission; most worlds of scenario `paper` need a third of them.
_CLAIRVOYANT_WORK = 2.0
# In wind it plans again in every step, this many steps ahead.
_WINDY_WORK = 0.3
_WINDY_STEPS = 10


class Teacher(Protocol):
    """Gives a reference action for each UAV, one after the other, and gets the action flown.

    Attributes:
        deviations: the largest share of steps in which the fleet deviates from the teacher's actions.
    """

    deviations: float

    def refer(self, uav: int, observation: Observation, taken: frozenset[int], deviating: bool) -> Action | None:
        """The reference action, sensor and velocity; None without one.

        Args:
            uav: index of the UAV.
            observation: of that UAV.
            taken: sensors chosen by earlier UAVs of this step.
            deviating: whether the fleet deviates from the teacher's actions in this step.
        """

    def flown(self, uav: int, step: int, action: Action) -> None:
        """Record the UAV's action in that step, which may differ from the reference."""

    def learn(self, uav: int, step: int, failed: bool) -> None:
        """Take the outcome of the UAV's action in that step."""


class PlannerTeacher(RecedingHorizonPolicy):
    """The receding-horizon planner with the fleet's belief; it has a reference action at every step."""

    deviations = 0.5

    def __init__(self, world: PipelineWorld) -> None:
        self.reset(world.scenario, 0)

    def refer(self, uav: int, observation: Observation, taken: frozenset[int], deviating: bool) -> Action | None:
        """The first action of a plan that continues the flight so far."""
        return self.decide(uav, observation, taken)

    def flown(self, uav: int, step: int, action: Action) -> None:
        """Fix the action for later plans."""
        self.belief.record_decision(uav, step, *action)


class ClairvoyantTeacher:
    """Plans to the mission's end with the true state of the world and all arrivals, and again after a deviation.

    It has no reference action in a step in which the fleet deviates.
    """

    deviations = 0.2

    def __init__(self, world: PipelineWorld) -> None:
        self._world = world
        self._plan: NDArray[np.int64] | None = None
        self._first_step = 0

    def refer(self, uav: int, observation: Observation, taken: frozenset[int], deviating: bool) -> Action | None:
        """The plan's action for this UAV."""
        if deviating:
            return None
        step = int(observation["step"][0])
        if self._plan is None or step >= self._first_step + len(self._plan):
            self._plan, self._first_step = self._planned(), step
        sensor, velocity = self._plan[step - self._first_step, uav].tolist()
        return int(sensor), int(velocity)

    def flown(self, uav: int, step: int, action: Action) -> None:
        """Discard the plan after another action than the plan's."""
        row = step - self._first_step
        if self._plan is not None and row < len(self._plan) and tuple(self._plan[row, uav]) != action:
            self._plan = None

    def learn(self, uav: int, step: int, failed: bool) -> None:
        """Nothing: the clairvoyant knows every outcome beforehand."""

    def _planned(self) -> NDArray[np.int64]:
        """The best flight ``(H, I, 2)`` found from the world's current state to its end, in wind for one step."""
        from simulator.bound.solver import Budget, plan

        world = self._world
        blows = world.truth.wind.blows
        if blows:
            from lab.exploration.wind import problem_in_wind, targets, velocities_towards

            problem = problem_in_wind(world, _WINDY_STEPS)
        else:
            problem = true_problem(world)
        # The search of simulator.bound.clairvoyant_bound ends by the clock; rollouts must repeat to the bit.
        budget = Budget(work=_WINDY_WORK if blows else _CLAIRVOYANT_WORK)
        actions = plan(problem, budget, "cautious").actions
        if not blows:
            return actions
        # In wind no step but the first one is flown as planned.
        first = actions[:1].copy()
        first[0, :, 1] = velocities_towards(world, targets(world, first[0, :, 1]))
        return first


TEACHERS: dict[TeacherName, type[PlannerTeacher] | type[ClairvoyantTeacher]] = {
    "planner": PlannerTeacher,
    "clairvoyant": ClairvoyantTeacher,
}

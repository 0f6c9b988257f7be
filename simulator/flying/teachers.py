"""Whose decisions the edge's modules learn to rank first: the planner, and one who knows every arrival beforehand."""

from __future__ import annotations

from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from simulator.policies.mpc import RecedingHorizon
from simulator.world import Observation, PipelineWorld

TeacherName = Literal["planner", "clairvoyant"]
Action = tuple[int, int]

# Deterministic seconds of search for what is left of a mission; most worlds of scenario `paper` are solved in a third.
_CLAIRVOYANT_WORK = 2.0


class Teacher(Protocol):
    """Says what it would do for each UAV in turn, and hears what was flown instead.

    Attributes:
        deviations: share of the steps in which the fleet leaves the teacher's way, at most.
    """

    deviations: float

    def refer(self, uav: int, observation: Observation, taken: frozenset[int], deviating: bool) -> Action | None:
        """Sensor and velocity; None where it has no answer.

        Args:
            uav: index of the UAV.
            observation: what the UAV knows.
            taken: sensors that UAVs decided earlier in this step chose.
            deviating: whether the fleet leaves the teacher's way in this step.
        """

    def flown(self, uav: int, step: int, action: Action) -> None:
        """What the UAV did in that step, which may be another thing."""


class Planner(RecedingHorizon):
    """The receding-horizon planner, which learns from the UAVs what a fleet learns, and answers at every step."""

    deviations = 0.5

    def __init__(self, world: PipelineWorld) -> None:
        self.reset(world.scenario, 0)

    def refer(self, uav: int, observation: Observation, taken: frozenset[int], deviating: bool) -> Action | None:
        """The first action of a plan that begins with what was flown so far."""
        return self.decide(uav, observation, taken)

    def flown(self, uav: int, step: int, action: Action) -> None:
        """Plans go on from this."""
        self.belief.tell(uav, step, *action)


class Clairvoyant:
    """Knows the true state of a world and all that will arrive; plans to the mission's end, and anew once it is left.

    It has no answer in a step in which the fleet leaves its way.
    """

    deviations = 0.2

    def __init__(self, world: PipelineWorld) -> None:
        self._world = world
        self._plan: NDArray[np.int64] | None = None
        self._begun = 0

    def refer(self, uav: int, observation: Observation, taken: frozenset[int], deviating: bool) -> Action | None:
        """The plan's action for this UAV."""
        if deviating:
            return None
        step = int(observation["step"][0])
        if self._plan is None:
            self._plan, self._begun = self._planned(step), step
        sensor, velocity = self._plan[step - self._begun, uav].tolist()
        return int(sensor), int(velocity)

    def flown(self, uav: int, step: int, action: Action) -> None:
        """Another action than the plan's ends it."""
        if self._plan is not None and tuple(self._plan[step - self._begun, uav]) != action:
            self._plan = None

    def _planned(self, step: int) -> NDArray[np.int64]:
        """The best flight ``(H, I, 2)`` found from the world as it is to its end."""
        from shared.fleetplan import Budget, FleetProblem, look_ahead, plan

        sensors, fleet = self._world.sensors, self._world.fleet
        problem = FleetProblem(
            scenario=self._world.scenario,
            trajectories=fleet.trajectories,
            progress_m=fleet.progress_m,
            places=sensors.positions,
            queue=sensors.queue,
            battery=sensors.battery,
            arrivals=sensors.arrivals[step:],
        )
        # Not simulator.flying.clairvoyant_bound: its search ends by the clock, and rollouts should repeat to the bit.
        return plan(problem, Budget(work=_CLAIRVOYANT_WORK), "cautious", look_ahead(problem)).actions


TEACHERS: dict[TeacherName, type[Planner] | type[Clairvoyant]] = {"planner": Planner, "clairvoyant": Clairvoyant}
